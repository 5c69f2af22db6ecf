"""What A is made from: splats and cameras, and the readers of their file formats."""
