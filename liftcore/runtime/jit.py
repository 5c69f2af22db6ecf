"""How kernels are compiled: without the interpreter lock, cached on disk by the content of the sources.

numba's cache looks at a kernel's own file only, so a change in a function that it calls from another file would go
unseen. The cache folder is therefore named after a digest of the files that kernels of other files call or take
constants from, so a stale kernel can never be loaded.
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

# What compiled code in other files is made of: a change in any of these compiles all kernels anew.
SHARED_SOURCES = (
    "runtime/jit.py",
    "raster/cpu/composite.py",
    "raster/cpu/project.py",
    "raster/cpu/simd.py",
    "scene/compositing.py",
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
