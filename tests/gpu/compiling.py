"""Compile the GPU backend's kernels for GPUs that this machine lacks: ``python -m tests.gpu.compiling``.

The products run on tensors of the CPU as ever, but each launch is compiled from the arguments that it came with and
the hints that Triton takes from them (which numbers are one, which numbers and addresses are multiples of 16), down
to machine code, and not run. Prints a line of JSON a kernel and card, and one a kind of splat that says what of a
lift's launches the warm-up had not.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any

import torch
import triton
from triton._C import libtriton
from triton.backends.compiler import BaseBackend, GPUTarget
from triton.compiler import ASTSource, make_backend

from liftcore.raster.cpu.warm_up import warm_up
from liftcore.raster.gpu import launching, raster, tiles, weights
from liftcore.raster.gpu.tiles import _cut as cut
from liftcore.runtime.device import Device
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel
from tests.scenes import random_camera, random_grid, random_regions, random_splats

if TYPE_CHECKING:
    from collections.abc import Callable

H100 = 90
OLDEST = 75  # what a lift of 3DGS launches most is compiled for it too
_compile: Any = triton.compile
_specialised: Any = libtriton.native_specialize_impl
_CARD = Device("cuda", torch.device("cpu"))


@dataclass(frozen=True)
class Launch:
    """A kernel and what Triton would make of its arguments: what it is compiled from, and looked up by."""

    kernel: Any
    arguments: tuple[tuple[str, Any], ...]  # of each parameter its type, and a hint or its constant value
    warps: int

    @property
    def name(self) -> str:
        """The kernel's."""
        return self.kernel.__name__

    @property
    def constants(self) -> dict[str, Any]:
        """Those that it was given."""
        pairs = zip(self.kernel.params, self.arguments, strict=True)
        return {param.name: value for param, (_, value) in pairs if param.is_constexpr}


def as_launched(kernel: Any, arguments: tuple[object, ...], warps: int, constants: dict[str, object]) -> Launch:
    """The launch as Triton's own launcher would see it."""
    types = []
    for number, param in enumerate(kernel.params):
        if param.is_constexpr:
            types.append(("constexpr", constants[param.name]))
            continue
        hints = not param.do_not_specialize, not param.do_not_specialize_on_alignment
        types.append(tuple(_specialised(BaseBackend, arguments[number], param.is_const, *hints)))
    return Launch(kernel, tuple(types), warps)


def compiled(launch: Launch, capability: int) -> dict[str, Any]:
    """Compile a launch for a GPU of this compute capability; return facts of the machine code."""
    target = GPUTarget("cuda", capability, 32)
    backend, names = make_backend(target), [param.name for param in launch.kernel.params]
    types = {name: kind for name, (kind, _) in zip(names, launch.arguments, strict=True)}
    values = {name: value for name, (kind, value) in zip(names, launch.arguments, strict=True) if kind == "constexpr"}
    hints = {(number,): backend.parse_attr(hint) for number, (kind, hint) in enumerate(launch.arguments)
             if kind != "constexpr" and hint}  # fmt: skip
    source = ASTSource(fn=launch.kernel, signature=types, constexprs=values, attrs=hints)
    options = {"num_warps": launch.warps, "num_stages": 1, "enable_fp_fusion": False}
    binary = _compile(source, target=target, options=options)
    ptx = binary.asm["ptx"]
    return {
        "kernel": launch.name, "card": capability, "constants": launch.constants, "hints": len(hints),
        "machine_code": len(binary.asm["cubin"]), "shared": binary.metadata.shared,
        "atomics": bool(re.search(r"\b(?:atom|red)\.", ptx)), "approximate_log": "lg2.approx" in ptx,
    }  # fmt: skip


def launches_of(work: Callable[[], None]) -> dict[Launch, None]:
    """Return the kernel launches of the work, each once."""
    launches: dict[Launch, None] = {}

    def note(kernel: Any, programs: int, *arguments: Any, warps: int = launching.WARPS, **constants: object) -> None:
        if programs:
            launches[as_launched(kernel, arguments, warps, constants)] = None
        for argument in arguments:  # what nothing wrote would be nought, and nothing be summed up
            if isinstance(argument, torch.Tensor) and argument.dtype == torch.float32:
                argument.fill_(1.0)
        if kernel is cut:  # a span for each splat, in the first tile
            by_name = dict(zip(signature(kernel.fn).parameters, arguments, strict=False))
            for name, value in (("rows", 0), ("firsts", 0), ("counts", 1)):
                by_name[name].fill_(value)

    modules: list[Any] = [tiles, weights]
    for module in modules:
        module.launch = note
    work()
    return launches


def _views(kernel: Kernel, params: CompositingParams, weighting: Weighting) -> None:
    """A lift's questions about two views that have no size in common; of grids for 3DGS alone."""
    splats = random_splats(3, kernel=kernel)
    gpu = raster.GpuRaster(splats, torch.device("cpu"))
    for width, height in ((32, 16), (161, 95)):
        camera = random_camera(3, width, height)
        for observation in (random_regions(3), random_grid(3))[: 2 if kernel is Kernel.GAUSSIAN_3D else 1]:
            gpu.region_weights(camera, observation, params, weighting)
        gpu.ray_rows(camera, torch.zeros(1, 2, dtype=torch.int32), params)
        gpu.ray_rows(camera, torch.zeros(17, 2, dtype=torch.int32), params)


def main() -> None:
    """The kernels of lifts of every kind of splat on an H100, and some of them on more cards."""
    raster.check_device = lambda _device: None
    launches: dict[Launch, None] = {}
    for kernel in Kernel:
        case = (
            (CompositingParams(opacity_logit_scale=1.2), Weighting(2))
            if kernel is Kernel.GAUSSIAN_3D
            else (CompositingParams(), Weighting())
        )
        warm = launches_of(partial(warm_up, kernel, _CARD, *case))
        lift = launches_of(partial(_views, kernel, *case))
        later = sorted({launch.name for launch in lift if launch not in warm})
        print(json.dumps({"kernel": str(kernel), "launches": len(lift), "compiled_in_the_lift": later}), flush=True)
        launches |= lift
    names = ("_weigh", "_add_runs", "_cut")
    everywhere = [next(launch for launch in launches if launch.name == name) for name in names]
    for launch in launches:
        for card in (H100, OLDEST) if launch in everywhere else (H100,):
            print(json.dumps(compiled(launch, card)), flush=True)


if __name__ == "__main__":
    main()
