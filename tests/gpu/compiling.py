"""Compile what the GPU backend launches for a card that is not here: ``python -m tests.gpu.compiling``.

The products run on tensors of the CPU as ever, but each launch is compiled from the arguments that it came with, down
to machine code of an H100, and not run. Prints a line of JSON a kernel.
"""

from __future__ import annotations

import json
import re
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from liftcore.raster.gpu import raster, rendering, selecting, sums, tracing, weighing
from liftcore.raster.protocol import Selection, Walk, Weighting
from liftcore.scene.splats import Kernel
from tests.scenes import random_camera, random_grid, random_regions, random_splats

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

H100 = GPUTarget("cuda", 90, 32)
_compile: Any = triton.compile
_POINTERS = {torch.float32: "*fp32", torch.float64: "*fp64", torch.int32: "*i32", torch.int64: "*i64"}
_SCALARS = {int: "i32", float: "fp32"}


def compiled_launch(kernel: Any, programs: int, *arguments: object, warps: int = 4, **constants: object) -> None:
    """In place of ``liftcore.raster.gpu.launching.launch``."""
    del programs
    signature, values = {}, dict(constants)
    for name, argument in zip(kernel.arg_names, arguments, strict=False):
        kind = _POINTERS[argument.dtype] if isinstance(argument, torch.Tensor) else _SCALARS[type(argument)]
        if isinstance(argument, int) and argument == 1:  # Triton makes a kernel of its own for these
            kind, values[name] = "constexpr", 1
        signature[name] = kind
    signature |= dict.fromkeys(constants, "constexpr")
    assert list(signature) == list(kernel.arg_names)
    source = ASTSource(fn=kernel, signature=signature, constexprs=values)
    binary = _compile(source, target=H100, options={"num_warps": warps, "num_stages": 1, "enable_fp_fusion": False})
    code, ptx = binary.asm["cubin"], binary.asm["ptx"]
    report = {
        "kernel": kernel.__name__, "constants": constants, "machine_code": len(code), "stack": _stack(code),
        "shared": binary.metadata.shared, "atomics": bool(re.search(r"\b(?:atom|red)\.", ptx)),
        "approximate_log": "lg2.approx" in ptx,
    }  # fmt: skip
    print(json.dumps(report), flush=True)


def _stack(machine_code: bytes) -> int:
    """Bytes a thread of what registers do not hold, as NVIDIA's tool in Triton's wheel reads it."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(machine_code)
        file.flush()
        tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
        told = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
    return int(re.findall(r"STACK:(\d+)", told)[0])


def _region_weights(splats: Splats, *, grid: bool, walk: Walk, weighting: Weighting) -> None:
    observation = random_grid(3) if grid else random_regions(3)
    gpu = raster.GpuRaster(splats, torch.device("cpu"))
    gpu.region_weights(random_camera(3), observation, walk, weighting)


def main() -> None:
    """The kernels of a lift for every kind of splat and more than one weighting, and all others for 3DGS."""
    for module in (rendering, selecting, sums, tracing, weighing):
        vars(module)["launch"] = compiled_launch
    raster.check_device = lambda _device: None
    for kernel in (Kernel.GAUSSIAN_2D, Kernel.BETA):
        _region_weights(random_splats(3, kernel=kernel), grid=False, walk=Walk(), weighting=Weighting())
    splats, camera = random_splats(3), random_camera(3)
    top = Weighting(2, Selection.TOP_K, count=3)
    _region_weights(splats, grid=True, walk=Walk(gain=1.2), weighting=top)
    _region_weights(splats, grid=False, walk=Walk(), weighting=replace(top, selection=Selection.CENTRE))
    gpu = raster.GpuRaster(splats, torch.device("cpu"))
    gpu.render(camera, torch.zeros(splats.count, rendering.WIDEST), Walk())
    gpu.adjoint(camera, torch.zeros(camera.height, camera.width, weighing.WIDEST), Walk())
    gpu.strongest_labels(camera, torch.zeros(splats.count, dtype=torch.int32), Walk())
    gpu.ray_rows(camera, torch.zeros(1, 2, dtype=torch.int32), Walk())
    gpu.row_sums(random_camera(3, 1, 1), Walk())


if __name__ == "__main__":
    main()
