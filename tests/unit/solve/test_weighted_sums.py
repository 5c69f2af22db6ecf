"""Sums of a block over strips of all codebooks: every entry once, whatever blocks, slices and threads there are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.errors import Unavailable
from liftcore.progress import silent
from liftcore.raster.base import RegionWeights
from liftcore.raster.cpu.lanes_rows import WIDE
from liftcore.solve import weighted_sums
from liftcore.solve.closed_form import BLOCK_ENTRIES, solve_closed_form
from liftcore.solve.columns import rows_of
from liftcore.solve.host import Host
from liftcore.solve.weighted_sums import LONG, SHARE, channel_slices, strip_bytes, strips_of

CHANNELS = 2 * WIDE + 9


def view(seed: int, lengths: np.ndarray, rows: int) -> RegionWeights:
    """W of a view: so many entries of each splat, none of those that have none."""
    rng = np.random.default_rng(seed)
    seen = np.flatnonzero(lengths)
    columns = [np.sort(rng.choice(rows, lengths[splat], replace=False)) for splat in seen]
    starts = np.concatenate([[0], np.cumsum(lengths[seen])]).astype(np.int64)
    ids = torch.from_numpy(seen.astype(np.int32))
    weights = torch.from_numpy(rng.random(starts[-1]).astype(np.float32))
    return RegionWeights(
        ids,
        torch.from_numpy(starts),
        torch.from_numpy(np.concatenate(columns).astype(np.int32)),
        weights,
        ids,
        weights,
    )


def dense(weights: RegionWeights, splats: int, rows: int) -> np.ndarray:
    found = np.zeros((splats, rows))
    splat = np.repeat(weights.splats.numpy(), np.diff(weights.indptr.numpy()))
    found[splat, weights.columns.numpy()] = weights.weights.numpy()
    return found


@pytest.fixture
def scene() -> tuple[list[RegionWeights], list[torch.Tensor], np.ndarray]:
    """Splats of no entries, of a few, and of more than float32 adds up one by one; more than a block and a share."""
    splats, rows = SHARE + 150, (700, 300)
    rng = np.random.default_rng(0)
    few, many = rng.integers(0, 4, splats), np.zeros(splats, np.int64)
    many[100:300] = 2 * LONG + 30
    assert many.sum() > BLOCK_ENTRIES
    store = [view(1, np.maximum(few, many), rows[0]), view(2, rng.integers(0, 3, splats), rows[1])]
    books = [torch.randn(count, CHANNELS, generator=torch.manual_seed(count)) for count in rows]
    totals = np.zeros(splats)
    for weights, count in zip(store, rows, strict=True):
        totals += dense(weights, splats, count).sum(axis=1)
    return store, books, totals


def solved(scene, host: Host | None = None) -> torch.Tensor:
    store, books, totals = scene
    return solve_closed_form(store, rows_of(books), totals, torch.float32, silent, host or Host(1)).features


def test_every_entry_of_every_view_counts_once(scene):
    store, books, totals = scene
    sums = sum(
        dense(weights, totals.size, len(book)) @ book.double().numpy()
        for weights, book in zip(store, books, strict=True)
    )
    expected = np.divide(sums, totals[:, None], out=np.zeros_like(sums), where=totals[:, None] > 0)
    np.testing.assert_allclose(solved(scene).numpy(), expected, atol=2e-6)
    assert (totals == 0).any()


@pytest.mark.parametrize("size", [1.0, 1e-33, 1e33])
def test_agreement_is_that_of_unit_vectors_whatever_their_length(scene, size):
    store, books, totals = scene
    books = [book * size * torch.linspace(0.5, 2.0, len(book))[:, None] for book in books]
    books[0][3] = 0  # a row of no direction agrees with none
    sums = np.zeros((totals.size, CHANNELS))
    for weights, book in zip(store, books, strict=True):
        units = torch.nn.functional.normalize(book.double(), dim=1, eps=1e-300).numpy()
        sums += dense(weights, totals.size, len(book)) @ units
    expected = np.linalg.norm(sums, axis=1) / np.where(totals > 0, totals, 1.0)
    found = solve_closed_form(store, rows_of(books), totals, torch.float32, silent, Host(1))
    np.testing.assert_allclose(found.agreement.numpy(), expected, atol=2e-6)
    near = np.abs(found.features.double().numpy()).max()
    assert 0.1 * size < near < 10 * size


def test_slices_of_channels_and_threads_change_no_bit(scene, monkeypatch):
    whole = solved(scene)
    assert torch.equal(whole, solved(scene, Host(3)))
    monkeypatch.setattr(weighted_sums, "STRIP_BYTES", 1)
    assert len(channel_slices(1000, CHANNELS, 4)) == 3
    assert torch.equal(whole, solved(scene))


def test_strips_hold_every_row_and_zeros_beyond_the_last_channel():
    channels = WIDE + 8
    books = [torch.arange(1.0 * rows * channels).reshape(rows, channels) + 1 for rows in (3, 5)]
    strips = strips_of(books, [3, 5], channels, torch.float32)
    assert (strips.rows, strips.number, strips.bases.tolist()) == (8, 2, [0, 3])
    assert strips.values.ctypes.data % 64 == 0
    assert strips.values.nbytes == strip_bytes(8, channels, 4)
    rows = strips.values.reshape(2, 8, WIDE).transpose(1, 0, 2).reshape(8, 2 * WIDE)
    np.testing.assert_array_equal(rows[:, :channels], torch.cat(books).numpy())
    assert not rows[:, channels:].any()


def test_more_rows_than_an_entry_can_name_are_refused():
    with pytest.raises(Unavailable, match=r"at most 2147483647 rows of codebooks.*got 2147483648 in 2 views"):
        strips_of([], [2**30, 2**30], 1, torch.float16)
