"""The closed form keeps its digits, and its bits however it is cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from liftcore.lifting.pieces import stacked
from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.one_piece import solve
from tests.unit.solve.sparse_views import codebook_of, of_dense, random_view

SPLATS = 700


def scene(channels: int) -> tuple[list[RegionWeights], list[Tensor]]:
    views = [random_view(k, 5 + k, SPLATS) for k in range(7)]
    books = [torch.randn(5 + k, channels, generator=torch.manual_seed(k)) for k in range(7)]
    return views, books


def solved(views, books) -> Tensor:
    return solve(stacked(views, SPLATS), codebook_of(books))


def test_sums_of_a_million_entries_and_of_many_views_keep_their_digits():
    books = [torch.full((1_000_000, 1), 0.7)]
    long = [of_dense(np.full((1, 1_000_000), 0.3))]
    views = [of_dense(np.full((1, 1), 0.3))] * 2_000
    for views_of_case, codebooks in ((long, books), (views, [torch.full((1, 1), 0.7)] * 2_000)):
        solution = solve(stacked(views_of_case, 1), codebook_of(codebooks))
        # One by one: the third digit.
        assert abs(float(solution[0, 0]) / float(torch.tensor(0.7)) - 1) < 5e-6


def test_tiny_and_huge_weights_give_means():
    views, books = scene(6)
    expected = solved(views, books)
    for factor in (2.0**-100, 2.0**100):
        scaled = [replace(view, weight=view.weight * factor) for view in views]
        assert torch.equal(solved(scaled, books), expected)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1, 7, 50]), st.sampled_from([1e-7, 1e-5, 1.0, 6e4]))
def test_float16_codebooks_give_the_bits_of_their_float32_twins(seed, channels, size):
    views = [random_view(seed + view, 5, 40) for view in range(3)]
    books = [(size * torch.rand(5, channels, generator=torch.manual_seed(seed))).half() for _ in views]
    W, before = stacked(views, 40), [book.clone() for book in books]
    solution = solve(W, codebook_of(books))
    assert torch.equal(solution, solve(W, codebook_of([book.float() for book in books])))
    mixed_books = [book.float() if k else book for k, book in enumerate(books)]
    assert torch.equal(solution, solve(W, codebook_of(mixed_books)))
    assert all(map(torch.equal, books, before))


def test_slices_of_channels_are_put_together(monkeypatch):
    views, books = scene(37)
    expected = solved(views, books)
    monkeypatch.setattr("liftcore.solve.codebook.TABLE_BYTES", 1)
    assert torch.equal(solved(views, books), expected)
