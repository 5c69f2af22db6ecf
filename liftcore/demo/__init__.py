"""The demo: a scene of published splat objects that ships with the project, and the walk through the service."""
