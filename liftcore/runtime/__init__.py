"""The base of all modules: devices, threads, compiled kernels, memory, progress, the version."""
