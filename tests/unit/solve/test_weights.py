"""Region weights: views stacked by splat, files, and selections of rows."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.errors import Unavailable
from liftcore.values import region_weights as weights
from liftcore.values.region_weights import RegionWeights, stacked
from tests.unit.solve.sparse_views import of_dense, random_view

SPLATS = 300


def views() -> list[RegionWeights]:
    return [random_view(k, 4 + k, SPLATS) for k in range(5)]


def assert_same(actual: RegionWeights, expected: RegionWeights) -> None:
    assert actual.views == expected.views
    for name, view_list in actual.tensors().items():
        assert torch.equal(view_list, getattr(expected, name)), name


def test_no_view_and_views_without_splats_are_rows_without_entries():
    empty = of_dense(np.zeros((SPLATS, 3)))
    for view_list in ([], [empty, empty]):
        W = stacked(view_list, SPLATS)
        assert W.region.numel() == 0 and not W.row_sums().any()
        assert W.indptr.tolist() == [0] * (SPLATS + 1)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are counted as Linux tells them")
def test_mapped_files_are_not_kept_open(tmp_path):
    views()[0].save(tmp_path / "w.safetensors")
    before = len(os.listdir("/proc/self/fd"))
    mapped = [RegionWeights.load(tmp_path / "w.safetensors") for _ in range(50)]  # a lift has as many as views
    assert len(os.listdir("/proc/self/fd")) == before
    mapped[0].weight[:] = 7.0  # stays in memory
    assert not torch.equal(mapped[0].weight, mapped[1].weight)
    assert_same(RegionWeights.load(tmp_path / "w.safetensors"), views()[0])


def test_more_regions_than_four_bytes_number_are_refused():
    oversized = weights.replace(random_view(0, 3, 5), offsets=torch.tensor([0, 2**30]))
    with pytest.raises(Unavailable, match="regions"):
        stacked([oversized] * 3, 5)
