"""Mask consensus, region reliability and confidence against their definitions, and what they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.lifting.pieces import stacked
from liftcore.solve.consensus import BELONGS, FAINT, OBSERVES, PRIOR
from liftcore.solve.reweight import SHARPNESS
from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.one_piece import mask_consensus, reweighting_of
from tests.unit.solve.sparse_views import codebook_of, dense, of_dense

SPLATS = 60


def random_scene(seed: int, views: int = 4, levels: int = 2) -> tuple[RegionWeights, np.ndarray]:
    """W of views whose levels part the splats in three to five regions, some on two of them; and the levels."""
    rng = np.random.default_rng(seed)
    parts, numbers = [], []
    for _ in range(views):
        columns = []
        for level in range(levels):
            regions = int(rng.integers(3, 6))
            view = np.zeros((SPLATS, regions))
            for splat in np.flatnonzero(rng.random(SPLATS) < 0.8):
                splat_regions = rng.choice(regions, int(rng.integers(1, 3)), replace=False)
                view[splat, splat_regions] = rng.uniform(0.02, 3.0, splat_regions.size)
            columns.append(view)
            numbers += [level] * regions
        parts.append(of_dense(np.concatenate(columns, axis=1)))
    return stacked(parts, SPLATS), np.array(numbers, np.int8)


def of_things(views: list[list[int]]) -> tuple[RegionWeights, np.ndarray]:
    """Four things of fifteen splats each; each view says in which of its regions each thing is (-1: none)."""
    parts = []
    for regions in views:
        view = np.zeros((SPLATS, max(regions) + 1))
        for number, region in enumerate(regions):
            if region >= 0:
                view[15 * number : 15 * number + 15, region] = 1.0
        parts.append(of_dense(view))
    return stacked(parts, SPLATS), np.zeros(sum(max(view) + 1 for view in views), np.int8)


def belonging(W: RegionWeights, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """W dense, the view of each region, the regions of each view and level, and B [P, M]: who belongs to what."""
    matrix, offsets = dense(W, SPLATS), W.offsets.numpy()
    view = np.searchsorted(offsets, np.arange(levels.size), side="right") - 1
    groups = [np.flatnonzero((view == v) & (levels == level)) for v in range(offsets.size - 1) for level in (0, 1)]
    groups = [group for group in groups if group.size]
    B = np.zeros_like(matrix, dtype=bool)
    for group in groups:
        sums = matrix[:, group].sum(axis=1, keepdims=True)
        B[:, group] = (sums > FAINT) & (matrix[:, group] >= BELONGS * sums) & (matrix[:, group] > 0)
    return matrix, view, groups, B


def defined(W: RegionWeights, levels: np.ndarray) -> np.ndarray:
    """The module's equation, line by line: c [P, M], zero where W is."""
    matrix, view, groups, B = belonging(W, levels)
    R = B.T @ (matrix.sum(axis=1)[:, None] * B)
    share_sums, views = np.zeros_like(matrix), np.zeros_like(matrix)
    for j, m in zip(*np.nonzero(matrix), strict=True):
        if levels[m] < 0:
            continue
        for v in range(W.offsets.numel() - 1):
            group_weights = [(group, R[m, group].sum()) for group in groups if v == view[group[0]] != view[m]]
            group_weights = [
                (group, sum_) for group, sum_ in group_weights if sum_ >= OBSERVES * R[m, m] and sum_ > 0
            ]
            shares = [R[m, n] / sum_ for group, sum_ in group_weights for n in group[B[j, group]]]
            if shares:
                share_sums[j, m] += max(shares)
                views[j, m] += 1
    mean = share_sums.sum() / views.sum() if views.any() else 1.0
    return np.where(matrix > 0, (share_sums + PRIOR * mean) / (views + PRIOR), 0.0)


def entries(W: RegionWeights, values: np.ndarray) -> np.ndarray:
    """Numbers of W's entries [nnz] as [P, M]."""
    return dense(replace(W, weight=torch.from_numpy(values)), SPLATS)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("levels", [1, 2])
def test_consensus_equals_its_definition(seed: int, levels: int) -> None:
    W, levels_of_regions = random_scene(seed, levels=levels)
    means = torch.from_numpy(np.random.default_rng(seed).normal(size=(SPLATS, 3)))
    for order in (None, means):  # in which splats are read
        got = entries(W, mask_consensus(W, levels_of_regions, means=order))
        np.testing.assert_allclose(got, defined(W, levels_of_regions), rtol=2e-5, atol=1e-6)


def test_cells_of_grids_take_no_part() -> None:
    W, levels = random_scene(5)
    levels[W.offsets[1] : W.offsets[2]] = -1
    np.testing.assert_allclose(entries(W, mask_consensus(W, levels)), defined(W, levels), rtol=2e-5, atol=1e-6)
    assert (mask_consensus(W, np.full_like(levels, -1)) == 1.0).all()


def test_more_tuples_than_the_first_table_holds_are_distinguished() -> None:
    rng = np.random.default_rng(1)
    views, splats = 14, np.arange(SPLATS)
    parts = []
    for _ in range(views):
        view = np.zeros((SPLATS, 60))
        view[splats, rng.integers(0, 30, SPLATS)] = view[splats, rng.integers(30, 60, SPLATS)] = 1
        parts.append(of_dense(view))
    W, levels = stacked(parts, SPLATS), np.tile(np.repeat([0, 1], 30), views).astype(np.int8)
    np.testing.assert_allclose(entries(W, mask_consensus(W, levels)), defined(W, levels), rtol=2e-5, atol=1e-6)


# Region reliability and confidence, which come in with a step of `reweight`.


def books_of(W: RegionWeights, seed: int) -> list[torch.Tensor]:
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.normal(size=(int(n), 5)).astype(np.float32)) for n in W.offsets.diff()]


def step_of(
    W: RegionWeights, books: list[torch.Tensor], q: np.ndarray, masks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Of a step with both: weights [P, M], confidence and what is explained [2, P], and the median reliability.

    Reliability is that of the masks [M] bool alone.
    """
    matrix, offsets = dense(W, SPLATS), W.offsets.numpy()
    view = np.searchsorted(offsets, np.arange(matrix.shape[1]), side="right") - 1
    unit = torch.nn.functional.normalize(torch.cat(books).double(), dim=1).numpy()
    mean = matrix.sum(axis=0) @ unit / matrix.sum()
    e = (unit - mean) / np.linalg.norm(unit - mean, axis=1, keepdims=True)
    sums = np.maximum(matrix.sum(axis=1, keepdims=True), 1e-300)
    shares = matrix / sums
    c, p = np.zeros_like(matrix), np.zeros_like(matrix)
    for v in range(offsets.size - 1):
        in_view = view == v
        other_sums = shares[:, ~in_view] @ e[~in_view]
        lengths = np.linalg.norm(other_sums, axis=1, keepdims=True)
        c[:, in_view] = np.where(lengths > 1e-6, (other_sums / np.maximum(lengths, 1e-300)) @ e[in_view].T, 0.0).clip(
            0, 1
        )
        p[:, in_view] = shares[:, in_view].sum(axis=1, keepdims=True)
    cosine_sums, region_totals = (matrix * (1 - p) * c).sum(axis=0), (matrix * (1 - p)).sum(axis=0)
    has_total = (region_totals > 1e-12) & masks
    r = np.divide(cosine_sums, region_totals, out=np.zeros_like(cosine_sums), where=has_total)
    median = float(np.sort(r[has_total])[(has_total.sum() - 1) // 2])
    mean_cosine = (matrix * c).sum() / matrix.sum()
    factors = np.where(has_total, r / median, 1.0) * q ** (SHARPNESS * (1 - median))
    after = matrix * ((1 - p) * c + p * mean_cosine) * factors
    after *= sums / np.maximum(after.sum(axis=1, keepdims=True), 1e-300)
    return after, (after * c).sum(axis=1) / sums[:, 0], median


@pytest.mark.parametrize("seed", [1, 2])
def test_reliability_and_confidence_equal_their_definition(seed: int) -> None:
    W, levels = random_scene(seed, views=5)
    masks = torch.ones(int(W.offsets[-1]), dtype=torch.bool)
    masks[: int(W.offsets[seed % 3])] = False  # of some views, as those of grids
    books, q = books_of(W, seed), mask_consensus(W, levels)
    consensus = torch.from_numpy(q)
    got = reweighting_of(W, codebook_of(books), masks=masks, consensus=consensus)
    after, confidence, median = step_of(W, books, entries(W, q), masks.numpy())
    assert got.reliability == pytest.approx(median, rel=1e-4)
    np.testing.assert_allclose(entries(W, (W.weight * got.factors).numpy()), after, rtol=2e-3, atol=1e-5)
    assert got.confidence is not None
    np.testing.assert_allclose(got.confidence.numpy(), confidence, rtol=2e-3, atol=1e-5)
