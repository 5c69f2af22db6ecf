"""The raster backends that the conformance suite holds to the oracle, and how many examples each is worth."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings

from liftcore.raster.cpu.raster import CpuRaster

if TYPE_CHECKING:
    from collections.abc import Callable

    from hypothesis.strategies import SearchStrategy

    from liftcore.raster.base import Raster
    from liftcore.raster.gpu.raster import GpuRaster
    from liftcore.scene.splats import Splats


def gpu_raster(splats: Splats) -> GpuRaster:
    """Return the GPU backend, on a GPU if there is one, else in Triton's interpreter."""
    from liftcore.raster.gpu.raster import GpuRaster

    return GpuRaster(splats, torch.device("cuda:0" if torch.cuda.is_available() else "cpu"))


@dataclass(frozen=True)
class Backend:
    """One implementation of ``liftcore.raster.base.Raster``."""

    name: str
    open: Callable[[Splats], Raster]
    examples: int  # of a property; interpreted kernels take a second where compiled ones take a millisecond
    seeds: int  # scenes of a pooled count
    splats: int = 60  # of a random scene, at most: more than a chunk of a tile's list
    size: tuple[int, int] = (50, 40)  # of a random image, at most: more than a tile each way
    rays: int = 2_000  # maximum number of rows of A that a test requests

    def holds(self, *strategies: SearchStrategy[Any]) -> Callable[[Callable[..., None]], None]:
        """Run a check on examples of the strategies at once."""

        def run(check: Callable[..., None]) -> None:
            slow = [HealthCheck.too_slow, HealthCheck.data_too_large]
            configure = settings(max_examples=self.examples, deadline=None, suppress_health_check=slow)
            configure(given(*strategies)(check))()

        return run


CPU = Backend("cpu", lambda splats: CpuRaster(splats, threads=2), examples=20, seeds=20)
GPU = Backend("gpu", gpu_raster, 20, 30)
if not torch.cuda.is_available():  # small scenes for the interpreter
    GPU = Backend("gpu", gpu_raster, examples=6, seeds=1, splats=24, size=(20, 18), rays=12)
# Where the lock has triton, to be without it is a failure.
locked = (sys.platform, platform.machine()) == ("linux", "x86_64")
needs_triton = pytest.mark.skipif(
    not locked and find_spec("triton") is None, reason="the lock has no triton for this machine"
)
every_backend = pytest.mark.parametrize(
    "backend", [CPU, pytest.param(GPU, marks=needs_triton)], ids=lambda backend: backend.name
)
