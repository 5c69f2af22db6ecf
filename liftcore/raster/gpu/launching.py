"""The border to Triton: where kernels can run, and how they are started.

Triton's own types describe neither launches nor what happens inside a kernel, so a kernel is a plain ``Any`` from
here on. All launches pass through ``launch``, with the same options.
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

lang: Any = triton.language  # the same module as ``tl``, for the functions whose types are not what kernels get
_triton: Any = triton

WARPS = 4  # of 32 threads, a program: two pixels of a tile a thread


# Numbers that change from view to view. A kernel of its own for 1 and for multiples of 16 would be compiled in the
# middle of a lift.
COUNTS = frozenset(
    {"band_tile", "own_tile", "slots_tile", "columns", "width", "height", "count", "runs"}
)  # fmt: skip


def jit(function: Callable) -> Any:
    """A Triton kernel, or a function that kernels call."""
    return _triton.jit(
        function, do_not_specialize=[name for name in signature(function).parameters if name in COUNTS]
    )


def interpreted() -> bool:
    """Whether kernels run in Triton's interpreter: so when TRITON_INTERPRET=1 was set before triton was imported."""
    return bool(_triton.knobs.runtime.interpret)


def check_device(device: torch.device) -> None:
    """Refuse a device that no kernel can run on.

    Raises:
        Unavailable: neither a CUDA device that is there, nor the CPU under Triton's interpreter.
    """
    if device.type == "cuda":
        if torch.cuda.is_available():
            return
        raise Unavailable(
            "device",
            expected="a CUDA device that torch can use",
            got="none",
            hint="install a CUDA build of torch on a machine with an NVIDIA card, or take the device cpu",
        )
    if device.type == "cpu" and interpreted():
        return
    raise Unavailable(
        "device",
        expected="a CUDA device",
        got=str(device),
        hint="on the CPU the GPU's kernels run in Triton's interpreter alone, for tests: set TRITON_INTERPRET=1",
    )


def launch(kernel: Any, programs: int, *arguments: object, warps: int = WARPS, **constants: object) -> None:
    """Run ``programs`` programs of a kernel.

    Products are not fused into sums, as the interpreter does not; exponentials and quotients are the card's.
    Loads are not moved into earlier rounds of a loop, for scratch is written there.
    """
    if programs == 0:
        return
    device = next(argument.device for argument in arguments if isinstance(argument, torch.Tensor))
    here = torch.cuda.device(device) if device.type == "cuda" else nullcontext()  # Triton starts on the current card
    with here, np.errstate(all="ignore"):  # the interpreter computes in numpy; infinities are the kernels' business
        kernel[(programs,)](*arguments, **constants, num_warps=warps, num_stages=1, enable_fp_fusion=False)
