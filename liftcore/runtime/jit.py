"""Decorators of numba kernels: without the interpreter lock, cached on disk by the content of the sources.

numba's cache checks a kernel's own file only, and would miss a change in a function that it calls from another file.
The cache folder is therefore named after a digest of the files from which kernels of other files call functions or
take constants, so a stale kernel is never loaded.
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

from liftcore.runtime.folders import cache_folder

# Files that kernels of other files depend on: a change in any of these recompiles all kernels.
SHARED_SOURCES = (
    "runtime/jit.py",
    "raster/cpu/composite.py",
    "raster/cpu/project.py",
    "raster/cpu/simd.py",
    "scene/compositing.py",
    "solve/shared_rows.py",
)


def _source_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for name in SHARED_SOURCES:
        digest.update((Path(__file__).parents[1] / name).read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    folder = cache_folder("kernels") / _source_digest()
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK):
        return folder
    # The home folder is not writable: compile in each process. A predictable name in the temporary folder would let
    # other users plant code, as cached kernels are code.
    private = Path(tempfile.mkdtemp(prefix="splatlift-kernels-"))
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return private


if not os.environ.get("NUMBA_CACHE_DIR"):
    config.__dict__["CACHE_DIR"] = str(_cache_folder())  # a plain module of settings, filled at import

kernel = njit(nogil=True, cache=True)
# Division by zero gives infinity or NaN: without a branch for it, loops are vectorised.
without_zero_checks = njit(nogil=True, cache=True, error_model="numpy")
inlined = njit(nogil=True, cache=True, inline="always")
# Sums may be reordered into lanes; the order is fixed at compile time, so results are still bitwise reproducible.
vectorised = njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})
