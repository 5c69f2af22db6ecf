"""The closed form in torch's own operations gives what the compiled one gives, however it is cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from liftcore.device import CPU, Device, indexed
from liftcore.progress import silent
from liftcore.raster.base import RegionWeights
from liftcore.solve import on_device, solver
from liftcore.solve.closed_form import Solution, solve_closed_form
from liftcore.solve.columns import Columns, rows_of
from liftcore.solve.device_blocks import GRAIN, SLICE_BYTES, block_bytes, device_slices, splat_blocks
from liftcore.solve.host import Host
from liftcore.solve.on_device import Place, solve_on_device, squared_lengths
from liftcore.solve.solver import closed_form
from liftcore.solve.totals import Totals, row_totals, sums_in_order
from liftcore.solve.view_weights import WeightStore

HERE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
SPLATS = 700  # three grains, the last not full


def random_view(seed: int, rows: int, splats: int = SPLATS, share: float = 0.4) -> RegionWeights:
    """W of a view: some splats, each with one to six entries."""
    rng = np.random.default_rng(seed)
    ids = np.flatnonzero(rng.random(splats) < share).astype(np.int32)
    lengths = rng.integers(1, min(6, rows) + 1, ids.size)
    columns = [np.sort(rng.choice(rows, length, replace=False)) for length in lengths]
    return view_of(ids, lengths, np.concatenate([np.zeros(0), *columns]), rng.random(int(lengths.sum())))


def view_of(ids, lengths, columns, weights) -> RegionWeights:
    starts = np.concatenate([[0], np.cumsum(lengths)])
    splats = torch.from_numpy(np.asarray(ids).astype(np.int32))
    return RegionWeights(
        splats,
        torch.from_numpy(starts.astype(np.int64)),
        torch.from_numpy(np.asarray(columns).astype(np.int32)),
        torch.from_numpy(np.asarray(weights).astype(np.float32)),
        splats,
        torch.ones(len(ids)),
    )


def sums_of(store: list[RegionWeights], splats: int = SPLATS) -> np.ndarray:
    total = np.zeros(splats)
    for view in store:
        total[view.splats.numpy()] += row_totals(view)
    return total


def dense(store: list[RegionWeights], books: list[Tensor], splats: int = SPLATS) -> np.ndarray:
    """``D^-1 W E`` by its definition, [P, F] f64; zero rows where D is zero."""
    X, totals = np.zeros((splats, books[0].shape[1])), np.zeros(splats)
    for view, book in zip(store, books, strict=True):
        starts, columns, weights = (t.numpy() for t in (view.indptr, view.columns, view.weights.double()))
        for row, splat in enumerate(view.splats.tolist()):
            own = slice(starts[row], starts[row + 1])
            X[splat] += weights[own] @ book.double().numpy()[columns[own]]
            totals[splat] += weights[own].sum()
    return np.divide(X, totals[:, None], out=X, where=totals[:, None] > 0)


def both(store, books, dtype, free=None, splats=SPLATS) -> tuple[Solution, Solution]:
    arguments = (store, rows_of(books), sums_of(store, splats), dtype, silent)
    return solve_closed_form(*arguments), solve_on_device(*arguments, Place(HERE, free))


def assert_same_bits(one: Solution, other: Solution) -> None:
    assert one.features.dtype == other.features.dtype
    assert torch.equal(one.features, other.features)
    assert torch.equal(one.agreement, other.agreement)


@pytest.mark.parametrize("channels", [1, 3, 70])
@pytest.mark.parametrize("unit", [True, False])
def test_features_and_agreement_are_those_of_the_compiled_closed_form(channels: int, unit: bool) -> None:
    store = [random_view(k, 5 + k) for k in range(7)]
    books = [torch.randn(5 + k, channels, generator=torch.manual_seed(k)) for k in range(7)]
    if unit:
        books = [torch.nn.functional.normalize(book, dim=1).half() for book in books]
    compiled, found = both(store, books, torch.float32)
    torch.testing.assert_close(found.features, compiled.features, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.agreement, compiled.agreement, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.features.numpy(), dense(store, books), rtol=1e-6, atol=1e-6)
    unseen = sums_of(store) == 0
    assert unseen.any() and not found.features[torch.from_numpy(unseen)].any()
    assert not found.agreement[torch.from_numpy(unseen)].any()
    halves = both(store, books, torch.float16)
    assert halves[0].features.dtype == halves[1].features.dtype == torch.float16
    torch.testing.assert_close(halves[1].features, halves[0].features, rtol=2**-10, atol=2**-24)


@pytest.mark.parametrize("size", [1e5, 1e-9, 3e38])
def test_what_float16_cannot_hold_is_float32_in_both(size: float) -> None:
    store = [random_view(k, 6) for k in range(3)]
    books = [size * torch.randn(6, 4, generator=torch.manual_seed(k)).clamp(-1, 1) for k in range(3)]
    compiled, found = both(store, books, torch.float16)
    assert found.features.dtype == compiled.features.dtype == torch.float32
    assert torch.isfinite(found.features).all()
    torch.testing.assert_close(found.features, compiled.features, rtol=1e-6, atol=1e-6 * size)


def test_no_bit_depends_on_the_memory_that_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    store = [random_view(k, 9) for k in range(5)]
    books = [torch.randn(9, 33, generator=torch.manual_seed(k)) for k in range(5)]
    whole, grains = both(store, books, torch.float32)[1], both(store, books, torch.float32, free=1)[1]
    assert_same_bits(whole, grains)
    calls = []
    gather = on_device.block_rows

    def crowded(store, books, splats, scale, place):
        calls.append(splats)
        if splats[1] - splats[0] > GRAIN:
            raise torch.OutOfMemoryError
        return gather(store, books, splats, scale, place)

    monkeypatch.setattr(on_device, "block_rows", crowded)
    assert_same_bits(whole, both(store, books, torch.float32)[1])
    assert calls[0] == (0, SPLATS) and len(calls) > 3
    monkeypatch.setattr(on_device, "GRAIN", SPLATS)  # no smaller block may be tried
    with pytest.raises(torch.OutOfMemoryError):
        both(store, books, torch.float32)


def test_slices_of_long_codebooks_are_put_together(monkeypatch: pytest.MonkeyPatch) -> None:
    store = [random_view(k, 9) for k in range(3)]
    books = [torch.randn(9, 37, generator=torch.manual_seed(k)) for k in range(3)]
    whole = both(store, books, torch.float32)[1]
    monkeypatch.setattr("liftcore.solve.device_blocks.SLICE", 8)
    told: list[tuple[int, int]] = []
    arguments = (store, rows_of(books), sums_of(store), torch.float32)

    def progress(stage: str, done: int, total: int, unit: str) -> None:
        told.append((done, total))

    cut = solve_on_device(*arguments, progress, Place(HERE, 1))
    assert torch.equal(cut.features, whole.features)
    torch.testing.assert_close(cut.agreement, whole.agreement, rtol=0, atol=1e-7)
    assert told[-1] == (5 * SPLATS, 5 * SPLATS) and told == sorted(told)


def test_sums_of_a_million_entries_and_of_many_views_keep_their_digits() -> None:
    book = torch.full((1, 1), 0.7)
    long = view_of([0], [1_000_000], np.zeros(1_000_000), np.full(1_000_000, 0.3))
    views = [view_of([0], [1], [0], [0.3]) for _ in range(2_000)]
    for store in ([long], views):
        solved = solve_on_device(
            store, [Columns(book)] * len(store), sums_of(store, 1), torch.float32, silent, Place(HERE)
        )
        error = abs(float(solved.features[0, 0]) / float(book) - 1)
        assert error < 5e-6  # of 256 equal terms; a million added one by one are wrong in the third digit


def test_scenes_that_no_view_shows_and_codebooks_of_zeros_are_zero() -> None:
    nothing = view_of([], [], [], [])
    found = both([nothing, nothing], [torch.ones(2, 3)] * 2, torch.float16)[1]
    assert not found.features.any() and not found.agreement.any()
    store = [random_view(0, 4)]
    compiled, zeros = both(store, [torch.zeros(4, 3)], torch.float16)
    assert zeros.features.dtype == compiled.features.dtype
    assert not zeros.features.any() and not zeros.agreement.any()


def test_tiny_and_huge_weights_give_means() -> None:
    store = [random_view(k, 5) for k in range(3)]
    books = [torch.randn(5, 6, generator=torch.manual_seed(k)) for k in range(3)]
    plain = both(store, books, torch.float32)[1]
    for factor in (2.0**-100, 2.0**100):
        scaled = [replace(view, weights=view.weights * factor) for view in store]
        assert torch.equal(both(scaled, books, torch.float32)[1].features, plain.features)


def test_norms_are_added_in_one_order_whatever_the_rows() -> None:
    values = torch.randn(300, 129, dtype=torch.float64, generator=torch.manual_seed(0))
    whole = squared_lengths(values)
    assert torch.equal(whole, torch.cat([squared_lengths(values[k : k + 1]) for k in range(300)]))
    torch.testing.assert_close(whole, values.square().sum(dim=1))


def test_blocks_are_whole_grains_that_fit_and_cover_all_splats() -> None:
    store = [random_view(k, 9, splats=10 * GRAIN + 5) for k in range(4)]
    starts = [view.indptr[torch.searchsorted(view.splats, torch.tensor([0, 2 * GRAIN]))] for view in store]
    entries = sum(int(pair[1] - pair[0]) for pair in starts)
    room = block_bytes(2 * GRAIN, entries, 16)
    blocks = splat_blocks(store, 10 * GRAIN + 5, 16, room)
    assert blocks[0] == (0, 2 * GRAIN)
    assert [first for first, _ in blocks[1:]] == [last for _, last in blocks[:-1]]
    assert blocks[-1][1] == 10 * GRAIN + 5
    assert all(first % GRAIN == 0 for first, _ in blocks)
    assert splat_blocks(store, 10 * GRAIN + 5, 16, 1 << 40) == [(0, 10 * GRAIN + 5)]
    assert len(splat_blocks(store, 10 * GRAIN + 5, 16, 0)) == 11


def test_slices_hold_their_bytes_down_to_a_least_width() -> None:
    assert device_slices(1_000, 700) == [(0, 512), (512, 700)]
    rows = SLICE_BYTES // (4 * 100)
    assert device_slices(rows, 250) == [(0, 100), (100, 200), (200, 250)]
    assert device_slices(10**9, 16) == [(0, 8), (8, 16)]


def test_weights_stay_on_the_card_while_there_is_room_and_come_home_when_asked() -> None:
    views = [random_view(k, 9) for k in range(4)]
    there = [RegionWeights(*(part.to(HERE) for part in vars(view).values())) for view in views]
    sizes = [sum(part.nbytes for part in vars(view).values()) for view in views]
    with WeightStore(memory_limit=sizes[2], card=(HERE, sizes[0] + sizes[1])) as store:
        for view in there:
            store.append(view)
        assert store.place == HERE and store.card_bytes == sizes[0] + sizes[1]
        assert store.bytes == sizes[2] + sizes[3] and store.mapped_bytes == sizes[3]
        assert store[0].columns.device == HERE and store[3].columns.device.type == "cpu"
        books = [torch.randn(9, 5, generator=torch.manual_seed(k)) for k in range(4)]
        mixed, plain = (
            solve_on_device(own, rows_of(books), sums_of(views), torch.float32, silent, Place(HERE))
            for own in (store, views)
        )
        assert_same_bits(mixed, plain)
        store.bring_home()
        assert store.card_bytes == 0 and store.bytes == sum(sizes) and store.mapped_bytes == sum(sizes) - sizes[2]
        for view, kept in zip(views, store, strict=True):
            assert all(
                torch.equal(first, second)
                for first, second in zip(vars(view).values(), vars(kept).values(), strict=True)
            )


def test_solution_without_room_beside_the_weights_brings_them_home(monkeypatch: pytest.MonkeyPatch) -> None:
    tries = []

    def crowded(store: WeightStore, *rest: object) -> str:
        tries.append(store.card_bytes)
        if store.card_bytes or len(tries) > 2:
            raise RuntimeError("Triton Error [CUDA]: out of memory")
        return "solved"

    monkeypatch.setattr(solver, "solve_on_device", crowded)
    rest = (rows_of([torch.zeros(1, 1)]), np.zeros(1), torch.float32, silent, Device("cuda", HERE), Host())
    with WeightStore(card=(HERE, 1 << 20)) as store:
        store.append(random_view(0, 3))
        if HERE.type == "cpu":  # a view of the host is no card's
            assert closed_form(store, *rest) == "solved" and tries[0] > 0 == tries[1]
        with pytest.raises(RuntimeError, match="out of memory"):
            [closed_form(store, *rest) for _ in range(3)]


def test_a_card_without_a_number_is_the_one_that_tensors_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert indexed(torch.device("cuda")) == torch.device("cuda", 1)
    assert indexed(torch.device("cuda", 0)) == torch.device("cuda", 0) and indexed(CPU.place) == CPU.place
    for free in (0, 1 << 20):  # the place of the sums knows nothing of the room for W
        assert WeightStore(card=(torch.device("cuda"), free)).place == torch.device("cuda", 1)


def test_both_ways_to_sum_over_views_are_one_sum() -> None:
    """With a stride of 3, whose 9 rays for one a float32 cannot multiply without rounding."""
    views = [random_view(k, 90) for k in range(4)]
    views = [replace(view, evidence=view.weights[: len(view.splats)].clone()) for view in views]
    host, card = Totals(SPLATS, CPU.place, by_torch=False), Totals(SPLATS, HERE, by_torch=True)
    for view in views:
        host.add(view, 9.0)
        card.add(view, 9.0)
    for (ours, theirs), rtol in zip(zip(host.found(), card.found(), strict=True), (0, 1e-14), strict=True):
        assert np.count_nonzero(ours) > SPLATS / 2
        np.testing.assert_allclose(theirs, ours, rtol=rtol, atol=0)


@pytest.mark.parametrize("place", {torch.device("cpu"), HERE}, ids=str)
def test_sums_over_views_are_those_of_the_definition(place: torch.device) -> None:
    views, found = [random_view(k, 5) for k in range(3)], Totals(SPLATS, place)
    for view in views:
        found.add(view, 4.0)
    evidence, denominators = found.found()
    np.testing.assert_allclose(denominators, sums_of(views), rtol=1e-12)
    assert evidence.sum() == 4.0 * sum(view.evidence.numel() for view in views)
    for view in views:
        own = sums_in_order(view.weights.double(), view.indptr).numpy()  # what a card does
        np.testing.assert_allclose(own, row_totals(view), rtol=1e-12)
    nothing = view_of([], [], [], [])
    assert sums_in_order(nothing.weights.double(), nothing.indptr).shape == (0,)
