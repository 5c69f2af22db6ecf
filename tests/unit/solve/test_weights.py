"""Region weights: views stacked by splat, files, and selections of rows."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.sparse_views import random_view

SPLATS = 300


def views() -> list[RegionWeights]:
    return [random_view(k, 4 + k, SPLATS) for k in range(5)]


def assert_same(actual: RegionWeights, expected: RegionWeights) -> None:
    assert actual.views == expected.views
    for name, view_list in actual.tensors().items():
        assert torch.equal(view_list, getattr(expected, name)), name


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are counted as Linux tells them")
def test_mapped_files_are_not_kept_open(tmp_path):
    views()[0].save(tmp_path / "w.safetensors")
    before = len(os.listdir("/proc/self/fd"))
    mapped = [RegionWeights.load(tmp_path / "w.safetensors") for _ in range(50)]  # a lift has as many as views
    assert len(os.listdir("/proc/self/fd")) == before
    mapped[0].weight[:] = 7.0  # stays in memory
    assert not torch.equal(mapped[0].weight, mapped[1].weight)
    assert_same(RegionWeights.load(tmp_path / "w.safetensors"), views()[0])
