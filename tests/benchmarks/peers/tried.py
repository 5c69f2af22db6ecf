"""Rasterizers of public registries that were tried on this CPU, and what stopped each: written down on that day."""

from __future__ import annotations

DAY = "2026-11-21"

RAN = (
    "`metal-gauss` 0.2.1 (PyPI, MIT) ran: its kernels are for Metal, but it brings a differentiable reference in "
    "torch, which takes part above where the package is installed."
)

STOPPED = {
    "`gsplat` 1.5.3": "installs, and compiles CUDA code at its first call; its torch twin calls the same code for "
    "what a tile meets",
    "`taichi-splatting` 0.13.0": "needs `taichi-nightly`, which the registry does not have; beside `taichi` 1.7.4 "
    "its import compiles CUDA code (`CUDA_HOME environment variable is not set`)",
    "`gswarp` 1.1.0": "installs beside `warp-lang` 1.19.0, which can run kernels on a CPU; says `means3D must be a "
    "CUDA tensor`",
    "`splax` 0.2.3": "needs JAX with CUDA, and says that it needs an NVIDIA GPU",
    "`mitsuba` 3.9.1": "installs and runs on a CPU; its `volprim_rf_basic` has another A: each kernel's peak along "
    "the ray, in the order of the ray's entries, no low-pass on the screen, alphas up to 0.9999, rays end at 0.01",
    "`easypytorch3d` 0.7.9.post1": "its `pulsar` renders spheres, not ellipsoids",
    "`litesplat` 0.1.1": "installs; another A: in the order of distance from a point, with scenes of its own format",
    "`gausscam` 0.1.5": "renders by WebGPU, without gradients or weights",
    "`splatstream` 0.1.4": "renders by Vulkan, without gradients or weights; its import misses X11 here",
    "`gaussian-renderer` 0.2.0, `splatkit` 0.1.0": "call `gsplat`",
    "`msplat`, `gsmod`": "no version for this platform",
    "`diff-gaussian-rasterization`, `torch-splatting`, `opensplat`, `jaxsplat`": "not on PyPI",
}
