"""How kernels are compiled: without the interpreter lock, cached on disk by the content of the sources.

numba's cache looks at a kernel's own file only, so a change in a function that it calls would go unseen. Here the
cache folder is named after a digest of all sources that kernels are made of, so a stale kernel can never be loaded.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import numba
from numba import njit
from numba.core import config


def _kernel_sources() -> list[Path]:
    """The files whose code or constants kernels are made of: a change in any other compiles nothing anew."""
    root = Path(__file__).parent
    cpu = root / "raster" / "cpu"
    own = [Path(__file__), root / "raster" / "constants.py", cpu / "records.py", *sorted(cpu.glob("lanes*.py"))]
    packages = [root / package for package in ("features", "raster", "solve", "query")]
    rooms = [source for package in packages for source in sorted(package.rglob("*.py"))]
    return own + [source for source in rooms if b"from liftcore.jit import" in source.read_bytes()]


def _source_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for source in _kernel_sources():
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "splatlift" / "kernels" / _source_digest()
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK):
        return folder
    # A home that cannot be written: compile anew in each process. A shared name in the temporary folder would let
    # others plant code, for cached kernels are code.
    private = Path(tempfile.mkdtemp(prefix="splatlift-kernels-"))
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return private


if not os.environ.get("NUMBA_CACHE_DIR"):
    config.__dict__["CACHE_DIR"] = str(_cache_folder())  # a plain module of settings, filled at import

kernel = njit(nogil=True, cache=True)
# Division by zero gives an infinity or none at all, as numbers do: without a branch for it loops become vectors.
without_zero_checks = njit(nogil=True, cache=True, error_model="numpy")
inlined = njit(nogil=True, cache=True, inline="always")
# Sums may be reordered into lanes; the order is fixed at compile time, so results still repeat to the bit.
vectorised = njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})
