"""The interface to Triton: checks of devices, compilation and launches of kernels.

Triton's types describe neither launches nor the code inside a kernel, so kernels have the type ``Any`` here. All
kernels are launched by ``launch``, with the same options.
"""

from __future__ import annotations

from contextlib import nullcontext
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import triton
import triton.language

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    from collections.abc import Callable

lang: Any = triton.language  # the same module as ``tl``, for functions whose types do not fit inside kernels
_triton: Any = triton

WARPS = 4  # per program, of 32 threads: two pixels of a tile per thread


# Arguments that change from view to view. Triton would specialise a kernel on 1 and on multiples of 16, and compile
# it in the middle of a lift.
COUNTS = frozenset({"columns", "width", "height", "count", "runs"})


def jit(function: Callable) -> Any:
    """Return a Triton kernel, or a function that kernels call."""
    return _triton.jit(
        function, do_not_specialize=[name for name in signature(function).parameters if name in COUNTS]
    )


def interpreted() -> bool:
    """Return True if kernels run in Triton's interpreter: TRITON_INTERPRET=1 was set before triton was imported."""
    return bool(_triton.knobs.runtime.interpret)


def check_device(device: torch.device) -> None:
    """Refuse a device that cannot run the kernels.

    Raises:
        Unavailable: neither an available CUDA device, nor the CPU under Triton's interpreter.
    """
    if device.type == "cuda":
        if torch.cuda.is_available():
            return
        raise Unavailable(
            "device",
            expected="a CUDA device that torch can use",
            got="none",
            hint="install a CUDA build of torch on a machine with an NVIDIA GPU, or use device='cpu'",
        )
    if device.type == "cpu" and interpreted():
        return
    raise Unavailable(
        "device",
        expected="a CUDA device",
        got=str(device),
        hint="for tests, set TRITON_INTERPRET=1 to run GPU kernels on the CPU in Triton's interpreter",
    )


def launch(kernel: Any, programs: int, *arguments: object, warps: int = WARPS, **constants: object) -> None:
    """Launch ``programs`` programs of a kernel.

    Products and sums are not fused, as the interpreter does not fuse them; exponentials and quotients are the GPU's.
    ``num_stages=1`` keeps loads in their iteration of a loop, as earlier iterations write to scratch.
    """
    if programs == 0:
        return
    device = next(argument.device for argument in arguments if isinstance(argument, torch.Tensor))
    current_device = torch.cuda.device(device) if device.type == "cuda" else nullcontext()  # as Triton's
    with current_device, np.errstate(all="ignore"):  # numpy, in the interpreter: kernels expect infinities
        kernel[(programs,)](*arguments, **constants, num_warps=warps, num_stages=1, enable_fp_fusion=False)
