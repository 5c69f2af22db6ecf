"""A still life made in code, whose truth is known by construction: splats, cameras, masks with mistakes."""
