"""Shared configuration of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Tests compute on the processor, whatever machine this is: `make gpu` alone lets them see a card. Where they see
# none, the GPU's kernels run in Triton's interpreter. Triton asks once, when it is imported.
if os.environ.get("TESTS_ON") != "cuda":
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# The same examples on every machine, however slow it is; a failure prints how to see it again.
settings.register_profile("everywhere", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("everywhere")

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scenes beside the repository; tests that need it say so when it is not there."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"shared data not found: {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels() -> None:
    """Compile the kernels once, before a test's time limit runs; processes that tests start load them from disk."""
    from liftcore.raster.cpu.warm_up import warm_up

    warm_up()


@pytest.fixture(scope="session")
def every_kernel() -> None:
    """The other kernels' compiled code too, for the tests that walk them."""
    from liftcore.raster.cpu.warm_up import warm_up
    from liftcore.scene.splats import Kernel

    for kernel in Kernel:
        warm_up(kernel)
