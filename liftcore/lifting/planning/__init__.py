"""Plans of lifts, before the first view: the views, the memory, contradictions of inputs."""
