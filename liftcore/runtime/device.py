"""The device of a lift: the CPU, or a GPU that torch and Triton can use."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.runtime.arguments import check_choice, device_name

OLDEST_CAPABILITY = (7, 5)  # compute capability that Triton and current builds of torch support
COMPILERS = ("gcc", "clang", "cc")
MEMORY_SIGNS = ("out of memory", "alloc_failed", "memoryallocation")  # of CUDA's libraries, lower case


@dataclass(frozen=True)
class Device:
    """The device of rasterization and solve."""

    kind: Literal["cpu", "cuda"]  # cuda on the CPU in Triton's interpreter, in which tests run the kernels
    place: torch.device  # of its tensors

    @property
    def name(self) -> str:
        """The name of the GPU or of the CPU."""
        if self.place.type == "cuda":
            return torch.cuda.get_device_name(self.place)
        return processor() if self.kind == "cpu" else f"Triton's interpreter on {processor()}"

    def facts(self) -> dict[str, Any]:
        """Return kind, name and versions of the libraries in use, for the diagnostics."""
        compiler = "numba" if self.kind == "cpu" else "triton"
        versions = {"torch": torch.__version__} | {name: version(name) for name in (compiler, "numpy")}
        if self.place.type == "cuda":
            versions |= {"cuda": str(torch.version.cuda)}
        return {"kind": self.kind, "name": self.name, "versions": versions}

    def free_bytes(self) -> int | None:
        """Return the free bytes of a GPU, those cached by torch included; None for the CPU."""
        if self.place.type != "cuda":
            return None
        cached = torch.cuda.memory_reserved(self.place) - torch.cuda.memory_allocated(self.place)
        return torch.cuda.mem_get_info(self.place)[0] + cached


CPU = Device("cpu", torch.device("cpu"))


def out_of_memory(error: BaseException) -> bool:
    """Return True if memory of the device ends: by torch, by the driver through Triton, or by a library."""
    has_sign = any(sign in str(error).lower() for sign in MEMORY_SIGNS)
    return isinstance(error, torch.OutOfMemoryError) or (isinstance(error, RuntimeError) and has_sign)


@contextmanager
def within_memory(device: Device) -> Iterator[None]:
    """Convert an out-of-memory error of work that cannot be split any further."""
    try:
        yield
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        free = (device.free_bytes() or 0) / 2**30
        raise Unavailable(
            "device", expected=f"enough memory for the lift on {device.name}", got=f"{free:.1f} GiB free",
            hint="end other programs on it, use fewer splats, smaller images or fewer channels, or use device=cpu",
        ) from None  # fmt: skip


def give_back_memory() -> None:
    """Return free memory of the allocator to the system, where it has such a call (glibc)."""
    # Views leave hundreds of megabytes in fragments, none of which fits the large arrays of the solve.
    trim = None if sys.platform == "win32" else getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def choose_device(name: str | torch.device) -> Device:
    """Return the device for ``auto`` (a GPU if one is available), ``cpu`` or ``cuda``, as `device_name` has it."""
    requested = device_name(name)
    check_choice("device", requested, ("auto", "cpu", "cuda"), InvalidSettings)
    if requested == "cpu":
        return CPU
    missing = _missing()
    if missing is None:
        return Device("cuda", torch.device("cuda", torch.cuda.current_device()))
    if requested == "auto":
        return CPU
    got, hint = missing
    expected = "a GPU that torch and Triton can use"
    raise Unavailable("device", expected=expected, got=got, hint=f"{hint}, or use device=cpu")


def _missing() -> tuple[str, str] | None:
    """Return why no GPU can be used, and a hint; None if one can."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__}, a build without CUDA", "install a CUDA build of torch"
    if not torch.cuda.is_available():
        driver = f"the driver supports CUDA {torch.version.cuda}"
        hint = f"check that nvidia-smi lists a GPU, that a container has access to it, and that {driver}"
        return "torch.cuda.is_available() is False", hint
    if importlib.util.find_spec("triton") is None:
        return "no package triton", "install the triton that this torch requires (CUDA builds include it)"
    if not (os.environ.get("CC") or any(shutil.which(name) for name in COMPILERS)):
        return "no C compiler, which Triton needs for its driver module", "install gcc and the headers of libc"
    capability = torch.cuda.get_device_capability()
    if capability < OLDEST_CAPABILITY:
        name, version_text = torch.cuda.get_device_name(), ".".join(map(str, capability))
        oldest = ".".join(map(str, OLDEST_CAPABILITY))
        return f"{name} of compute capability {version_text}", f"Triton needs {oldest}: choose another GPU"
    return None


@cache
def processor() -> str:
    """Return the name of the CPU."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
