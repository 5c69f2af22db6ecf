"""The raster on the processor: kernels that numba compiles."""
