"""Plans of lifts, before the first view: the views, the memory, the order of photos, contradictions of inputs."""
