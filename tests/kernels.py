"""Compile the kernels of nearly all tests: ``python -m tests.kernels [KERNEL...]``, which `make test` runs first.

Tests run in two processes, and each would compile the same code. Kernels of few tests are compiled in these tests,
once.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from liftcore.lifting.files import lift_files
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel
from liftcore.values.settings import LiftSettings
from tests.promises.tiny_files import write_files


def main() -> None:
    """The kernels that are named, else every one; of 3D Gaussians each weighting; and a lift."""
    for kernel in map(Kernel, sys.argv[1:] or Kernel):
        warm_up(kernel)
    warm_up(params=CompositingParams(opacity_logit_scale=1.2))
    warm_up(weighting=Weighting(top_k=1))
    with tempfile.TemporaryDirectory() as name:
        files = write_files(Path(name))
        lift_files(files["splats"], files["cameras"], [files["features"]], LiftSettings.of(device="cpu"))


if __name__ == "__main__":
    main()
