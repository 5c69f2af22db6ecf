"""Places along the curve: the bits of the cells, an axis after the other."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from liftcore.solve.curve import places_along_curve

CELLS = 2**21 - 1


def woven(cells: list[int]) -> int:
    """Bit k of axis a at place 3k + a."""
    return sum((cell >> bit & 1) << (3 * bit + axis) for axis, cell in enumerate(cells) for bit in range(21))


@given(npst.arrays(np.int64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.integers(0, CELLS)))
def test_places_are_woven_from_the_bits_of_the_cells(cells: np.ndarray) -> None:
    ends = np.array([[0, 0, 0], [CELLS, CELLS, CELLS]])
    points = np.concatenate([ends, cells])  # float32 holds each of these numbers
    found = places_along_curve(torch.from_numpy(points.astype(np.float32)))
    assert found.tolist() == [woven(cell) for cell in points.tolist()]


def test_the_frame_and_its_unit_are_of_no_matter() -> None:
    points = torch.randint(0, 1000, (200, 3), generator=torch.Generator().manual_seed(0)).float()
    found = places_along_curve(points)
    assert np.array_equal(found, places_along_curve(points * 2.0**-40))
    assert np.array_equal(found, places_along_curve(points + 4096))
    assert len(set(found.tolist())) > 190


def test_a_flat_scene_a_single_point_and_none_have_places() -> None:
    flat = torch.tensor([[0.0, 5.0, 1.0], [1.0, 5.0, 0.0], [1.0, 5.0, 1.0]])
    first, second, third = places_along_curve(flat).tolist()
    assert (first | second, first & second) == (third, 0)
    assert places_along_curve(flat[:1]).tolist() == [0]
    assert places_along_curve(flat[:0]).tolist() == []


def test_the_largest_coordinates_keep_their_order() -> None:
    largest = float(np.finfo(np.float32).max)
    points = torch.tensor([[-largest, 0.0, 0.0], [0.0, 0.0, 0.0], [largest, 0.0, 0.0]])
    places = places_along_curve(points).tolist()
    assert places == sorted(places) and places[0] == 0 and places[2] == woven([CELLS, 0, 0])
