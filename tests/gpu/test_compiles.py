"""Kernels compile to machine code without a GPU: the compiler accepts less than the interpreter."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from liftcore.scene.splats import Kernel
from tests.backends import needs_triton

pytestmark = needs_triton
ROOT = Path(__file__).parents[2]
SHARED_MEMORY = 64 * 1024  # bytes a block: what cards of 2018 have, later ones more


@pytest.fixture(scope="module")
def reports() -> list[dict]:
    """Return the reports that ``tests.gpu.compiling`` prints, one a line."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    process = subprocess.run(
        [sys.executable, "-m", "tests.gpu.compiling"],
        cwd=ROOT, env=environment | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=900,
        check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-4000:]
    return [json.loads(line) for line in process.stdout.splitlines()]


@pytest.fixture(scope="module")
def compiled(reports) -> list[dict]:
    """Return a report for each kernel that the products launch, and each GPU."""
    return [report for report in reports if "card" in report]


def test_every_kernel_compiles_for_an_h100(compiled):
    names = {report["kernel"] for report in compiled}
    assert names == {"_weigh", "_add_runs", "_cut"}
    assert {report["constants"]["KIND"] for report in compiled if report["kernel"] == "_weigh"} == {0, 1, 2}
    assert all(report["machine_code"] > 0 and report["hints"] > 3 for report in compiled)


def test_a_lifts_kernels_compile_for_cards_of_turing(compiled):
    for kernel in ("_weigh", "_add_runs", "_cut"):
        assert {report["card"] for report in compiled if report["kernel"] == kernel} == {75, 90}


def test_nothing_is_compiled_in_the_time_of_a_lift(reports):
    """Whatever the sizes of its views are: the warm-up launched all that a lift launches."""
    lifts = [report for report in reports if "card" not in report]  # one for each kind of splat
    assert {lift["kernel"] for lift in lifts} == {str(kernel) for kernel in Kernel}
    assert all(lift["launches"] >= 3 and lift["compiled_in_the_lift"] == [] for lift in lifts)


def test_no_kernel_adds_by_atomics_or_loses_the_digits_of_logarithms_near_one(compiled):
    assert not any(report["atomics"] or report["approximate_log"] for report in compiled)


def test_kernels_fit_the_shared_memory_of_consumer_cards(compiled):
    assert max(report["shared"] for report in compiled) <= SHARED_MEMORY
