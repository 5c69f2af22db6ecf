"""W splat by splat along the curve: every entry once, whatever the chunks, and no bit of X from the order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.progress import silent
from liftcore.solve import closed_form, gathering, host
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.columns import rows_of
from liftcore.solve.curve import places_along_curve
from liftcore.solve.gathering import Gathering, chunk_ranges
from liftcore.solve.host import FEW_CHANNELS, Host
from liftcore.solve.weight_tables import WeightTables
from liftcore.solve.weighted_sums import LEAST_SHARE, SHARE, splat_shares
from tests.unit.solve.test_on_device import dense, random_view, sums_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.solve.gathering import Chunk

SPLATS, ROWS = SHARE + 300, 40  # more than a call of compiled code takes
BASES = np.array([0, ROWS, 2 * ROWS])


@pytest.fixture(scope="module")
def store() -> list:
    return [random_view(view, ROWS, SPLATS) for view in range(3)]


@pytest.fixture(scope="module")
def means() -> torch.Tensor:
    return torch.rand(SPLATS, 3, generator=torch.Generator().manual_seed(0))


def chunks_of(store: list, curve: np.ndarray | None, row_bytes: int = 1) -> list[Chunk]:
    """Copies, as each chunk is gone when the next one is asked for."""
    with ThreadPoolExecutor(2) as pool:

        def each_share(work: Callable[[tuple[int, int]], None], first: int, last: int) -> None:
            list(pool.map(work, splat_shares(first, last, 2)))

        found = Gathering(each_share, WeightTables(store), (BASES, np.ones(SPLATS)), curve, row_bytes)
        copies = []
        for splats, entries in found:
            last = entries.starts[-1]
            own = entries._replace(rows=entries.rows[:last].copy(), shares=entries.shares[:last].copy())
            copies.append(gathering.Chunk(splats, own))
        return copies


def as_matrix(chunks: list[Chunk]) -> np.ndarray:
    found = np.zeros((SPLATS, 3 * ROWS))
    for splats, entries in chunks:
        for k, splat in enumerate(splats):
            own = slice(entries.starts[k], entries.starts[k + 1])
            assert (np.diff(entries.rows[own]) > 0).all()  # in the order of the views, which is that of the sums
            found[splat, entries.rows[own]] += entries.shares[own]
    return found


@pytest.mark.parametrize("entries", [100, 5_000, 1 << 24])
def test_every_entry_is_gathered_once_in_chunks_along_the_curve(store, means, monkeypatch, entries: int) -> None:
    monkeypatch.setattr(gathering, "CHUNK_ENTRIES", entries)
    curve = places_along_curve(means)
    chunks = chunks_of(store, curve)
    total = sum(part.columns.numel() for part in store)
    assert total / entries < len(chunks) <= total / entries + 2
    assert all((np.diff(curve[chunk.splats].astype(np.int64)) >= 0).all() for chunk in chunks)
    assert np.array_equal(np.sort(np.concatenate([chunk.splats for chunk in chunks])), np.arange(SPLATS))
    books = [torch.eye(3 * ROWS)[view * ROWS : (view + 1) * ROWS] for view in range(3)]
    wanted = dense(store, books, SPLATS) * sums_of(store, SPLATS)[:, None]
    np.testing.assert_allclose(as_matrix(chunks), wanted, rtol=1e-6)


def test_without_places_the_order_is_that_of_the_file(store) -> None:
    (chunk,) = chunks_of(store, None)
    assert np.array_equal(chunk.splats, np.arange(SPLATS))


def test_order_chunks_shares_and_threads_change_no_bit(store, means, monkeypatch) -> None:
    monkeypatch.setattr(host, "FEW_CHANNELS", 0)
    books = [torch.randn(ROWS, 70, generator=torch.Generator().manual_seed(view)) for view in range(3)]
    totals = sums_of(store, SPLATS)

    def solved(machine: Host) -> closed_form.Solution:
        return solve_closed_form(store, rows_of(books), totals, torch.float16, silent, machine)

    def assert_same(other: closed_form.Solution) -> None:
        assert torch.equal(whole.features, other.features)
        assert torch.equal(whole.agreement, other.agreement)

    whole = solved(Host(1))
    np.testing.assert_allclose(whole.features.double(), dense(store, books, SPLATS), atol=2e-3)
    units = [book / book.norm(dim=1, keepdim=True) for book in books]
    agreement = np.linalg.norm(dense(store, units, SPLATS), axis=1)
    np.testing.assert_allclose(whole.agreement, agreement, atol=1e-6)
    assert_same(solved(Host(1, means=means)))
    monkeypatch.setattr(gathering, "CHUNK_ENTRIES", 700)
    assert_same(solved(Host(3, means=means)))
    monkeypatch.setattr(gathering, "CHUNK_BYTES", 10_000)
    assert_same(solved(Host(40, means=means)))


def test_few_channels_keep_the_order_of_the_file(store, means, monkeypatch) -> None:
    asked = []

    def places(points: torch.Tensor) -> np.ndarray:
        asked.append(len(points))
        return places_along_curve(points)

    monkeypatch.setattr(host, "places_along_curve", places)
    for channels in (FEW_CHANNELS, FEW_CHANNELS + 1):
        books = [torch.ones(ROWS, channels) for _ in range(3)]
        solve_closed_form(store, rows_of(books), sums_of(store, SPLATS), torch.float16, silent, Host(1, means=means))
    assert asked == [SPLATS]


@pytest.mark.parametrize("threads", [1, 2, 64])
@pytest.mark.parametrize("ends", [(0, 0), (5, 6), (7, 100_000), (0, 3_000_000)])
def test_shares_are_enough_for_all_threads_and_hold_each_splat_once(threads: int, ends: tuple[int, int]) -> None:
    shares = splat_shares(*ends, threads)
    sizes = [last - first for first, last in shares]
    assert all(one[1] == other[0] for one, other in pairwise([(0, ends[0]), *shares, (ends[1], 0)]))
    assert sum(sizes) == ends[1] - ends[0]
    assert all(0 < size <= SHARE for size in sizes)
    assert len(shares) >= min(threads, sum(sizes) // LEAST_SHARE)


@given(st.lists(st.integers(0, 50), min_size=1, max_size=60), st.integers(1, 200), st.integers(1, 400))
def test_chunks_follow_one_another_and_keep_to_what_they_may_hold(counts, entries, rows) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gathering, "CHUNK_ENTRIES", entries)
        patch.setattr(gathering, "CHUNK_BYTES", rows)
        ranges = chunk_ranges(np.array(counts), 1)
    assert ranges[0][0] == 0 and ranges[-1][1] == len(counts)
    assert all(one[1] == other[0] for one, other in pairwise(ranges))
    for first, last in ranges:
        assert first < last
        # A splat more, as chunks end with whole splats.
        assert sum(counts[first:last]) <= entries + max(counts)
        assert last - first <= rows + 1
