"""What every module runs on: devices, threads, compiled kernels, memory, progress, the version."""
