"""Region weights that are mapped from files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.sparse_views import random_view


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are counted as Linux tells them")
def test_mapped_files_are_not_kept_open(tmp_path):
    W = random_view(0, 4, 300)
    W.save(tmp_path / "w.safetensors")
    before = len(os.listdir("/proc/self/fd"))
    mapped = [RegionWeights.load(tmp_path / "w.safetensors") for _ in range(50)]  # a lift has as many as views
    assert len(os.listdir("/proc/self/fd")) == before
    mapped[0].weight[:] = 7.0  # stays in memory
    assert not torch.equal(mapped[0].weight, mapped[1].weight)
    for name, column in RegionWeights.load(tmp_path / "w.safetensors").tensors().items():
        assert torch.equal(column, getattr(W, name)), name
