"""Memberships of W on a GPU's device against those of the processor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.solve import membership_on_card
from liftcore.solve.membership import FAINT, RegionGroups, memberships
from liftcore.solve.membership_on_card import memberships_on_card
from liftcore.values.region_weights import RegionWeights, stacked
from tests.unit.solve.sparse_views import of_dense, random_view

SPLATS, REGIONS, VIEWS = 200, 9, 5


def scene(seed: int) -> tuple[RegionWeights, np.ndarray]:
    """W of views with regions of three levels in any order and cells of grids; some groups are faint, rows empty."""
    rng = np.random.default_rng(seed)
    parts = []
    for view in range(VIEWS):
        matrix = random_view(10 * seed + view, REGIONS, SPLATS, share=0.6).matrix(SPLATS).toarray()
        matrix[rng.random(SPLATS) < 0.3] *= FAINT
        parts.append(of_dense(matrix))
    return stacked(parts, SPLATS), rng.integers(-1, 3, REGIONS * VIEWS).astype(np.int8)


@pytest.mark.parametrize("rows", [3, 1 << 18])
@pytest.mark.parametrize("seed", range(3))
def test_memberships_on_a_card_are_the_processors(seed: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership_on_card, "BLOCK_ROWS", rows)
    W, levels = scene(seed)
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    expected, got = memberships(W, groups), memberships_on_card(W, groups)
    assert expected.own_region.any() and not expected.own_region.all()
    np.testing.assert_array_equal(got.own_region.numpy(), expected.own_region)
    np.testing.assert_array_equal(got.totals.numpy(), expected.totals)


def test_a_scene_without_entries_has_no_members() -> None:
    W = stacked([of_dense(np.zeros((SPLATS, 3)))] * 2, SPLATS)
    got = memberships_on_card(W, RegionGroups.of(W.offsets.numpy(), np.zeros(6, np.int8)))
    assert got.own_region.shape == (0,) and torch.equal(got.totals, torch.zeros(SPLATS, dtype=torch.float64))
