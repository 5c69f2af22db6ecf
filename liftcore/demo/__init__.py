"""The still life of `splatlift demo`: a scene made in code, and the walk through the service."""
