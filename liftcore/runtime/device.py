"""Where a lift's arithmetic runs: on the processor, or on a card that torch and Triton can use."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import re
import shutil
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.runtime.device_name import device_name

if TYPE_CHECKING:
    from collections.abc import Iterator

OLDEST_CARD = (7, 5)  # the compute capability that Triton and today's builds of torch have code for
COMPILERS = ("gcc", "clang", "cc")
DRIVER = Path("/proc/driver/nvidia/version")
MEMORY_SIGNS = ("out of memory", "alloc_failed", "memoryallocation")  # CUDA's, cuBLAS's and its kin's, lower case
_EXPECTED = "a card that CUDA, torch and Triton can use"
_OR_CPU = "or take device=cpu"


@dataclass(frozen=True)
class Device:
    """What runs the raster and the solution.

    ``cuda`` beside a place that is no card is Triton's interpreter, in which tests run the kernels.
    """

    kind: Literal["cpu", "cuda"]
    place: torch.device  # of its tensors

    @property
    def name(self) -> str:
        """The card's name, or the processor's."""
        if self.place.type == "cuda":
            return torch.cuda.get_device_name(self.place)
        return processor() if self.kind == "cpu" else f"Triton's interpreter on {processor()}"

    def facts(self) -> dict[str, Any]:
        """Kind, name and the versions of what computes there, as the certificate tells them."""
        packages = ("torch", "numba", "numpy") if self.kind == "cpu" else ("torch", "triton", "numpy")
        versions = {"torch": torch.__version__} | {name: version(name) for name in packages[1:]}
        if self.place.type == "cuda":
            versions |= {"cuda": str(torch.version.cuda), "driver": driver_version()}
        return {"kind": self.kind, "name": self.name, "versions": versions}

    def free_bytes(self) -> int | None:
        """Bytes that may still be taken there, with those that torch holds and does not use; None off a card."""
        if self.place.type != "cuda":
            return None
        held = torch.cuda.memory_reserved(self.place) - torch.cuda.memory_allocated(self.place)
        return torch.cuda.mem_get_info(self.place)[0] + held


CPU = Device("cpu", torch.device("cpu"))


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a device's memory ran out: torch's own, the driver's by Triton, or a library's."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    told = str(error).lower()
    return isinstance(error, RuntimeError) and any(sign in told for sign in MEMORY_SIGNS)


@contextmanager
def within_memory(device: Device) -> Iterator[None]:
    """Say in words that a card has no room, where work could not be cut any smaller.

    Raises:
        Unavailable: an allocation failed there.
    """
    try:
        yield
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        free = (device.free_bytes() or 0) / 2**30
        raise Unavailable(
            "device", expected=f"room for the lift on {device.name}", got=f"too little: {free:.1f} GiB are free now",
            hint="end what else runs there, take fewer splats, smaller images or fewer channels, or take device=cpu",
        ) from None  # fmt: skip


def give_back_memory() -> None:
    """Have the allocator return what is free; where there is no such call (glibc has it), nothing happens.

    Views leave hundreds of megabytes of pieces between what is kept, and the solution's large arrays fit in none.
    """
    trim = None if sys.platform == "win32" else getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def indexed(place: torch.device) -> torch.device:
    """A place as tensors name theirs: ``cuda`` without a number is the card that is current now."""
    if place.type == "cuda" and place.index is None:
        return torch.device("cuda", torch.cuda.current_device())
    return place


def choose_device(name: str | torch.device) -> Device:
    """The device that ``auto``, ``cpu`` or ``cuda`` stands for here; ``auto`` takes a card where one can be used.

    The current card may also be named by its number, ``cuda:0``.

    Raises:
        InvalidSettings: another name.
        Unavailable: ``cuda`` was asked for and cannot be had.
    """
    asked = device_name(name)
    if asked not in ("auto", "cpu", "cuda"):
        raise InvalidSettings("device", expected="'auto', 'cpu' or 'cuda'", got=repr(asked)[:80])
    if asked == "cpu":
        return CPU
    missing = _missing()
    if missing is None:
        return Device("cuda", torch.device("cuda", torch.cuda.current_device()))
    if asked == "cuda":
        got, hint = missing
        raise Unavailable("device", expected=_EXPECTED, got=got, hint=f"{hint}, {_OR_CPU}")
    return CPU


def _missing() -> tuple[str, str] | None:
    """What keeps lifts off a card here, and what to do about it; None where nothing does."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__}, a build without CUDA", "install a CUDA build of torch"
    if not torch.cuda.is_available():
        known = f"the driver knows CUDA {torch.version.cuda}"
        hint = f"see whether nvidia-smi lists one, a container was given it, and {known}"
        return "no card that CUDA sees", hint
    if importlib.util.find_spec("triton") is None:
        return "no triton beside torch", "install the triton that this torch asks for (CUDA builds bring it)"
    if not (os.environ.get("CC") or any(shutil.which(name) for name in COMPILERS)):
        return "no C compiler, with which Triton makes its link to the driver", "install gcc and the headers of libc"
    capability = torch.cuda.get_device_capability()
    if capability < OLDEST_CARD:
        name, own = torch.cuda.get_device_name(), ".".join(map(str, capability))
        oldest = ".".join(map(str, OLDEST_CARD))
        return f"{name} of compute capability {own}", f"Triton needs {oldest}: choose another card"
    return None


@cache
def processor() -> str:
    """The processor's name."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def driver_version(told: Path = DRIVER) -> str:
    """The version of NVIDIA's kernel module, ``unknown`` where Linux does not tell."""
    with suppress(OSError):
        found = re.search(r"Kernel Module.*?\b(\d+(?:\.\d+)+)", told.read_text(encoding="utf-8"))
        if found:
            return found[1]
    return "unknown"
