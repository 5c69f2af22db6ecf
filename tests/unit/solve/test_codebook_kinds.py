"""Codebooks are summed where they lie, as float16 or as float32, and it makes no difference to the bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.progress import silent
from liftcore.raster.base import RegionWeights
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.columns import rows_of
from liftcore.solve.gathering import WIDE
from liftcore.solve.host import Host

ROWS = 5


def sparse(seed: int, splats: int) -> RegionWeights:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(0, ROWS + 1, splats)
    columns = np.concatenate([np.sort(rng.permutation(ROWS)[:length]) for length in lengths]).astype(np.int32)
    ids = torch.arange(splats, dtype=torch.int32)
    starts = torch.from_numpy(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64))
    weights = torch.from_numpy(rng.random(columns.size).astype(np.float32))
    return RegionWeights(ids, starts, torch.from_numpy(columns), weights, ids, torch.ones(splats))


def solved(store, books, splats: int) -> torch.Tensor:
    return solve_closed_form(store, rows_of(books), np.full(splats, 3.0), torch.float32, silent, Host(1)).features


@given(st.integers(0, 2**31), st.sampled_from([1, 7, WIDE, 50, 3 * WIDE]), st.sampled_from([1e-7, 1e-5, 1.0, 6e4]))
def test_float16_codebooks_give_the_sums_of_their_float32_twins_to_the_bit(seed, channels, size):
    generator = torch.Generator().manual_seed(seed)
    books = [(size * torch.rand(ROWS, channels, generator=generator)).half() for _ in range(3)]
    store = [sparse(seed + view, 40) for view in range(3)]
    found = solved(store, books, 40)
    assert torch.equal(found, solved(store, [book.float() for book in books], 40))
    assert found.any() or not any(book.any() for book in books)


@pytest.mark.parametrize("kinds", [(torch.float16, torch.float32), (torch.float32, torch.float16)])
def test_codebooks_of_several_kinds_are_summed_as_float32(kinds):
    books = [torch.rand(ROWS, 40, generator=torch.Generator().manual_seed(1)).half().to(kind) for kind in kinds]
    store = [sparse(view, 10) for view in range(2)]
    assert torch.equal(solved(store, books, 10), solved(store, [book.float() for book in books], 10))


def test_codebooks_that_are_no_unit_vectors_are_as_they_were_after_the_solution():
    books = [torch.full((ROWS, WIDE), 2.0), torch.full((ROWS, WIDE), 3.0)]
    before = [book.clone() for book in books]
    solved([sparse(view, 10) for view in range(2)], books, 10)
    assert all(torch.equal(book, old) for book, old in zip(books, before, strict=True))
