"""Inputs of the weight matrix A: splats and cameras, and their geometry."""
