"""Shared configuration of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Tests run on the CPU on every machine; only `make gpu` lets them use a GPU. Without one, the GPU's kernels run in
# Triton's interpreter. Triton reads this variable once, at its import.
if os.environ.get("TESTS_ON") != "cuda":
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# The same examples on every machine, without a time limit; a failure prints how to reproduce it.
settings.register_profile("everywhere", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("everywhere")

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scenes next to the repository; skip the test if it is missing."""
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
    """Compile the other kernels too, for the tests that use them."""
    from liftcore.raster.cpu.warm_up import warm_up
    from liftcore.scene.splats import Kernel

    for kernel in Kernel:
        warm_up(kernel)
