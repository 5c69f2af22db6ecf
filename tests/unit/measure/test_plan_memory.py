"""The plan held against lifts, on a small scene."""

from __future__ import annotations

import sys

import pytest

from tests.benchmarks.plan_memory import MIB, measure_lift, table_of
from tests.unit.solve.test_lift_equals_dense import write_scene


def test_a_lift_in_a_process_of_its_own_is_measured_beside_its_plan(tmp_path):
    row = measure_lift(*write_scene(tmp_path, 2), {"robust_steps": 1})
    assert 0 < row["entries"] < 3 * row["entries_planned"]
    assert row["planned_bytes"] == sum(row["parts"].values())
    assert row["resident_bytes"] > 100 * MIB  # of libraries alone
    if sys.platform == "linux":
        assert 50 * MIB < row["anonymous_bytes"] < row["resident_bytes"]
    document = {"rows": [row | {"features": "some", "settings": {"robust_steps": 1}}], "hardware": {"cpu": "a"}}
    told = table_of(document).splitlines()
    assert told[2].split()[:2] == ["some,", "robust_steps=1"]
    assert int(told[2].split()[4]) == round(row["planned_bytes"] / MIB)
    assert told[3] == "cpu a"


def test_a_lift_that_ends_without_an_answer_is_told(tmp_path):
    paths = write_scene(tmp_path, 2)
    paths[2].write_bytes(b"no pack")
    with pytest.raises(RuntimeError, match=r"features\.safetensors with {} ended with the code 1"):
        measure_lift(*paths, {})
