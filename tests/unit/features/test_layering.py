"""Masks that overlap are laid on levels with no pixel lost, always in the same way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liftcore.errors import InvalidFeatures
from liftcore.features.masks import MAX_LEVELS, layered


@st.composite
def boxes(draw: st.DrawFn) -> np.ndarray:
    """[K, 9, 12] bool, boxes and their differences, some empty."""
    masks = np.zeros((draw(st.integers(1, 12)), 9, 12), bool)
    for mask in masks:
        for value in (True, False):
            top, left = draw(st.integers(0, 8)), draw(st.integers(0, 11))
            mask[top : top + draw(st.integers(0, 9)), left : left + draw(st.integers(0, 12))] = value
    return masks


@given(boxes())
def test_every_mask_is_whole_on_one_level(masks: np.ndarray) -> None:
    labels = layered(list(masks), "a.json")
    assert labels.dtype == np.int32 and labels.shape[1:] == masks.shape[1:]
    for number, mask in enumerate(masks):
        here = labels == number
        assert np.array_equal(here.any(axis=0), mask)
        assert here.any(axis=(1, 2)).sum() == mask.any()
    assert all((level >= 0).any() for level in labels[1:])


def test_largest_masks_come_first_and_of_equals_the_first() -> None:
    masks = np.zeros((4, 1, 6), bool)
    for number, (start, end) in enumerate([(0, 2), (0, 4), (2, 4), (3, 5)]):
        masks[number, 0, start:end] = True
    assert layered(list(masks), "a.json").tolist() == [
        [[1, 1, 1, 1, -1, -1]],
        [[0, 0, 2, 2, -1, -1]],
        [[-1, -1, -1, 3, 3, -1]],
    ]


def test_masks_without_overlap_and_masks_without_pixels_take_one_level() -> None:
    masks = np.concatenate([np.eye(5, dtype=bool)[:, None], np.zeros((2, 1, 5), bool)])
    assert layered(list(masks), "a.json").tolist() == [[[0, 1, 2, 3, 4]]]
    assert layered([np.zeros((2, 2), bool)], "a.json").tolist() == [[[-1, -1], [-1, -1]]]


def test_too_many_masks_over_a_pixel_are_told_with_their_number() -> None:
    masks = [np.ones((2, 2), bool)] * MAX_LEVELS
    assert len(layered(masks, "a.json")) == MAX_LEVELS
    with pytest.raises(
        InvalidFeatures, match=r"a\.json: .*33 masks, up to 33 of them over one pixel; .*box_nms_thresh"
    ):
        layered([*masks, np.ones((2, 2), bool)], "a.json")
