"""The GPU backend: A of a scene by Triton kernels on an NVIDIA GPU, or in Triton's interpreter on any machine.

Nothing outside this package imports triton, and nothing imports this package before a GPU is requested.
"""
