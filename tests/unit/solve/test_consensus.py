"""Mask consensus, region reliability and confidence against their definitions, and what they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.solve import consensus
from liftcore.solve.consensus import OBSERVES, PRIOR, mask_consensus
from liftcore.solve.membership import BELONGS, FAINT
from liftcore.solve.reweight import SHARPNESS, Reweighting, reweighting_factors
from liftcore.values.levels import region_levels
from liftcore.values.region_weights import RegionWeights, stacked
from liftcore.values.views import Regions
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
                own = rng.choice(regions, int(rng.integers(1, 3)), replace=False)
                view[splat, own] = rng.uniform(0.02, 3.0, own.size)
            columns.append(view)
            numbers += [level] * regions
        parts.append(of_dense(np.concatenate(columns, axis=1)))
    return stacked(parts, SPLATS), np.array(numbers, np.int8)


def of_things(views: list[list[int]]) -> tuple[RegionWeights, np.ndarray]:
    """Four things of fifteen splats each; each view says in which of its regions each thing is (-1: none)."""
    parts = []
    for regions in views:
        view = np.zeros((SPLATS, max(regions) + 1))
        for thing, region in enumerate(regions):
            if region >= 0:
                view[15 * thing : 15 * thing + 15, region] = 1.0
        parts.append(of_dense(view))
    return stacked(parts, SPLATS), np.zeros(sum(max(view) + 1 for view in views), np.int8)


def belonging(W: RegionWeights, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """W dense, the view of each region, the regions of each view and level, and B [P, M]: who belongs to what."""
    whole, offsets = dense(W, SPLATS), W.offsets.numpy()
    view = np.searchsorted(offsets, np.arange(levels.size), side="right") - 1
    groups = [np.flatnonzero((view == v) & (levels == level)) for v in range(offsets.size - 1) for level in (0, 1)]
    groups = [group for group in groups if group.size]
    B = np.zeros_like(whole, dtype=bool)
    for group in groups:
        sums = whole[:, group].sum(axis=1, keepdims=True)
        B[:, group] = (sums > FAINT) & (whole[:, group] >= BELONGS * sums) & (whole[:, group] > 0)
    return whole, view, groups, B


def defined(W: RegionWeights, levels: np.ndarray) -> np.ndarray:
    """The module's equation, line by line: c [P, M], zero where W is."""
    whole, view, groups, B = belonging(W, levels)
    R = B.T @ (whole.sum(axis=1)[:, None] * B)
    asked, views = np.zeros_like(whole), np.zeros_like(whole)
    for j, m in zip(*np.nonzero(whole), strict=True):
        if levels[m] < 0:
            continue
        for v in range(W.offsets.numel() - 1):
            seen = [(group, R[m, group].sum()) for group in groups if v == view[group[0]] != view[m]]
            seen = [(group, sum_) for group, sum_ in seen if sum_ >= OBSERVES * R[m, m] and sum_ > 0]
            shares = [R[m, n] / sum_ for group, sum_ in seen for n in group[B[j, group]]]
            if shares:
                asked[j, m] += max(shares)
                views[j, m] += 1
    usual = asked.sum() / views.sum() if views.any() else 1.0
    return np.where(whole > 0, (asked + PRIOR * usual) / (views + PRIOR), 0.0)


def entries(W: RegionWeights, values: np.ndarray) -> np.ndarray:
    """Numbers of W's entries [nnz] as [P, M]."""
    return dense(replace(W, weight=torch.from_numpy(values)), SPLATS)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("levels", [1, 2])
def test_consensus_equals_its_definition(seed: int, levels: int) -> None:
    W, own = random_scene(seed, levels=levels)
    means = torch.from_numpy(np.random.default_rng(seed).normal(size=(SPLATS, 3)))
    for order in (None, means):  # in which splats are read
        got = entries(W, mask_consensus(W, own, means=order))
        np.testing.assert_allclose(got, defined(W, own), rtol=2e-5, atol=1e-6)


def test_cells_of_grids_take_no_part() -> None:
    W, levels = random_scene(5)
    levels[W.offsets[1] : W.offsets[2]] = -1
    np.testing.assert_allclose(entries(W, mask_consensus(W, levels)), defined(W, levels), rtol=2e-5, atol=1e-6)
    assert (mask_consensus(W, np.full_like(levels, -1)) == 1.0).all()


def test_a_mask_of_two_things_weighs_less() -> None:
    W, levels = of_things([[0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 3], [0, 0, 1, 2]])
    found = entries(W, mask_consensus(W, levels))
    merged = int(W.offsets[3])
    assert (found[:30, merged] < 0.7).all()
    assert (found[30:45, merged + 1] > 0.9).all()


def test_a_whole_beside_its_parts_is_no_mistake() -> None:
    parts, whole = [0, 1, 2, 3], [0, 0, 1, 1]
    view = np.zeros((SPLATS, 6))
    for thing in range(4):
        rows = slice(15 * thing, 15 * thing + 15)
        view[rows, parts[thing]] = view[rows, 4 + whole[thing]] = 1.0
    W = stacked([of_dense(view)] * 3, SPLATS)
    np.testing.assert_allclose(mask_consensus(W, np.array([0, 0, 0, 0, 1, 1] * 3, np.int8)), 1.0, rtol=1e-6)


def test_threads_and_blocks_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    W, levels = random_scene(7, views=9)
    one = mask_consensus(W, levels, 1)
    assert mask_consensus(W, levels, 2).tobytes() == one.tobytes()
    monkeypatch.setattr(consensus, "BLOCK_ENTRIES", 256)  # the memory that it takes beside an entry's own numbers
    assert mask_consensus(W, levels, 2).tobytes() == one.tobytes()


def test_more_tuples_than_the_first_table_holds_are_told_apart() -> None:
    rng = np.random.default_rng(1)
    views, every = 14, np.arange(SPLATS)
    parts = []
    for _ in range(views):
        view = np.zeros((SPLATS, 60))
        view[every, rng.integers(0, 30, SPLATS)] = view[every, rng.integers(30, 60, SPLATS)] = 1
        parts.append(of_dense(view))
    W, levels = stacked(parts, SPLATS), np.tile(np.repeat([0, 1], 30), views).astype(np.int8)
    np.testing.assert_allclose(entries(W, mask_consensus(W, levels)), defined(W, levels), rtol=2e-5, atol=1e-6)


def test_a_scene_without_entries_has_none() -> None:
    W = stacked([of_dense(np.zeros((SPLATS, 3)))] * 2, SPLATS)
    assert mask_consensus(W, np.zeros(6, np.int8)).shape == (0,)


def test_the_level_of_a_region_is_where_it_is_labelled() -> None:
    labels = torch.tensor([[[0, 1], [-1, 1]], [[2, 3], [2, -1]]], dtype=torch.int32)
    assert region_levels(Regions(labels, torch.ones(5, 2))).tolist() == [0, 0, 1, 1, -1]


# Region reliability and confidence, which come in with a step of `reweight`.


def books_of(W: RegionWeights, seed: int) -> list[torch.Tensor]:
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.normal(size=(int(n), 5)).astype(np.float32)) for n in W.offsets.diff()]


def every(W: RegionWeights) -> torch.Tensor:
    """All regions, [M] bool."""
    return torch.ones(int(W.offsets[-1]), dtype=torch.bool)


def step_of(
    W: RegionWeights, books: list[torch.Tensor], q: np.ndarray, masks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Of a step with both: weights [P, M], confidence and what is explained [2, P], and the median reliability.

    Reliability is that of the masks [M] bool alone.
    """
    whole, offsets = dense(W, SPLATS), W.offsets.numpy()
    view = np.searchsorted(offsets, np.arange(whole.shape[1]), side="right") - 1
    unit = torch.nn.functional.normalize(torch.cat(books).double(), dim=1).numpy()
    mean = whole.sum(axis=0) @ unit / whole.sum()
    e = (unit - mean) / np.linalg.norm(unit - mean, axis=1, keepdims=True)
    sums = np.maximum(whole.sum(axis=1, keepdims=True), 1e-300)
    shares = whole / sums
    c, p = np.zeros_like(whole), np.zeros_like(whole)
    for v in range(offsets.size - 1):
        own = view == v
        others = shares[:, ~own] @ e[~own]
        lengths = np.linalg.norm(others, axis=1, keepdims=True)
        c[:, own] = np.where(lengths > 1e-6, (others / np.maximum(lengths, 1e-300)) @ e[own].T, 0.0).clip(0, 1)
        p[:, own] = shares[:, own].sum(axis=1, keepdims=True)
    told, counted = (whole * (1 - p) * c).sum(axis=0), (whole * (1 - p)).sum(axis=0)
    known = (counted > 1e-12) & masks
    r = np.divide(told, counted, out=np.zeros_like(told), where=known)
    median = float(np.sort(r[known])[(known.sum() - 1) // 2])
    usual = (whole * c).sum() / whole.sum()
    factors = np.where(known, r / median, 1.0) * q ** (SHARPNESS * (1 - median))
    after = whole * ((1 - p) * c + p * usual) * factors
    after *= sums / np.maximum(after.sum(axis=1, keepdims=True), 1e-300)
    told = np.stack([(after * c).sum(axis=1), (after * ((1 - p) * c + p * usual)).sum(axis=1)])
    return after, told / sums[:, 0], median


@pytest.mark.parametrize("on_card", [False, True], ids=["processor", "card"])
@pytest.mark.parametrize("seed", [1, 2])
def test_reliability_and_confidence_equal_their_definition(seed: int, on_card: bool) -> None:
    W, levels = random_scene(seed, views=5)
    masks = every(W)
    masks[: int(W.offsets[seed % 3])] = False  # of some views, as those of grids
    books, q = books_of(W, seed), mask_consensus(W, levels)
    consensus = torch.from_numpy(q)
    got = reweighting_factors(W, codebook_of(books), 1, reliability=masks, consensus=consensus, on_card=on_card)
    after, (confidence, explained), median = step_of(W, books, entries(W, q), masks.numpy())
    assert got.reliability == pytest.approx(median, rel=1e-4)
    np.testing.assert_allclose(entries(W, (W.weight * got.factors).numpy()), after, rtol=2e-3, atol=1e-5)
    assert got.confidence is not None and got.view_consistency is not None
    np.testing.assert_allclose(got.confidence.numpy(), confidence, rtol=2e-3, atol=1e-5)
    met = got.view_consistency.numpy()[W.row_sums().numpy() > 0]
    np.testing.assert_allclose(met, explained[W.row_sums().numpy() > 0], rtol=2e-3, atol=1e-5)


def test_reliability_changes_no_bit_with_threads() -> None:
    W, levels = random_scene(3, views=6)
    q = torch.from_numpy(mask_consensus(W, levels))

    def made(threads: int) -> Reweighting:
        return reweighting_factors(
            W, codebook_of(books_of(W, 3)), 1, threads=threads, reliability=every(W), consensus=q
        )

    one, two = made(1), made(2)
    assert torch.equal(one.factors, two.factors)
    assert one.confidence is not None and two.confidence is not None
    assert torch.equal(one.confidence, two.confidence)


def test_a_region_with_a_wrong_word_loses_weight_everywhere() -> None:
    W, _ = of_things([[0, 1, 2, 3]] * 5)
    words = torch.eye(4)
    wrong = words[[1, 1, 2, 3]]  # of the last view's first region
    books = [words] * 4 + [wrong]
    plain, relied = (
        reweighting_factors(W, codebook_of(books), 1, reliability=told).factors for told in (None, every(W))
    )
    lying = int(W.offsets[4])
    assert float(relied[W.region == lying].max()) <= float(plain[W.region == lying].min())
    got = reweighting_factors(W, codebook_of(books), 1, reliability=every(W))
    assert got.confidence is not None
    assert float(got.confidence[15:].min()) > 0.5
