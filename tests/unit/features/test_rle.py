"""Run lengths say the masks that COCO's own tools read in them, and nothing else passes for run lengths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liftcore.errors import InvalidFeatures
from liftcore.features.masks import mask_of_runs, read_runs
from tests.run_lengths import compressed, lengths_of


def mask_of(segmentation: Any) -> np.ndarray:
    return mask_of_runs(*read_runs(segmentation, "a.json mask 0"))


@given(
    st.integers(1, 70).flatmap(
        lambda height: st.lists(st.lists(st.booleans(), min_size=height, max_size=height), min_size=1, max_size=12)
    )
)
def test_every_mask_comes_back_from_both_forms(columns: list[list[bool]]) -> None:
    mask = np.array(columns).T
    lengths = lengths_of(mask)
    for counts in (lengths, compressed(lengths)):
        assert np.array_equal(mask_of({"size": [*mask.shape], "counts": counts}), mask)


@given(st.lists(st.integers(0, 1 << 20), min_size=1, max_size=40))
def test_long_runs_come_back(lengths: list[int]) -> None:
    lengths = [*lengths, 5461 * 32768 - sum(lengths)]
    size, found = read_runs({"size": [5461, 32768], "counts": compressed(lengths)}, "a.json mask 0")
    assert (size, found.tolist()) == ((5461, 32768), lengths)


def test_pixels_go_down_the_columns() -> None:
    assert mask_of({"size": [2, 3], "counts": [1, 2, 3]}).tolist() == [[False, True, False], [True, False, False]]


@pytest.mark.parametrize(
    ("counts", "box"),
    [
        # Two results of image 139 in cocodataset/cocoapi, results/instances_val2014_fakesegm100_results.json, and
        # their boxes x, y, width, height in instances_val2014_fakebbox100_results.json there.
        (r"Tde64k<;O1000000000000000000001O1O`\^1", (513.22, 205.75, 14.74, 15.97)),
        (r"WQ\52Q=7N200000000O2OL4IVRj2", (413.25, 219.02, 9.63, 12.52)),
    ],
)
def test_strings_that_coco_published_fill_the_boxes_that_it_published(
    counts: str, box: tuple[float, float, float, float]
) -> None:
    rows, columns = np.nonzero(mask_of({"size": [426, 640], "counts": counts}))
    x, y, width, height = box
    assert np.allclose([columns.min(), columns.max() + 1], [x, x + width], atol=0.5)
    assert np.allclose([rows.min(), rows.max() + 1], [y, y + height], atol=0.5)


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ([[1.0, 2.0, 3.0, 4.0]], r"run lengths \{size, counts\}, got a polygon; .*output_mode"),
        ({"counts": [6]}, "got another thing"),
        (None, "got another thing"),
        ({"size": [2, 3, 1], "counts": [6]}, r"size \[h, w\], got \[2, 3, 1\]"),
        ({"size": [2.0, 3], "counts": [6]}, r"size \[h, w\]"),
        ({"size": [True, 6], "counts": [6]}, r"size \[h, w\]"),
        ({"size": [0, 3], "counts": [0]}, r"sides in 1\.\.32768"),
        ({"size": [-2, -3], "counts": [6]}, r"sides in 1\.\.32768"),
        ({"size": [32769, 1], "counts": [32769]}, r"sides in 1\.\.32768"),
        ({"size": [32768, 32768], "counts": [1 << 30]}, "at most 178956970 pixels"),
        ({"size": [2, 3], "counts": [1, 2]}, r"sum up to 2 x 3 = 6, got a sum of 3; the file is cut off"),
        ({"size": [2, 3], "counts": [1, 2, 10**30]}, "sum up to 2 x 3"),
        ({"size": [2, 3], "counts": []}, "got a sum of 0"),
        ({"size": [2, 3], "counts": ""}, "got a sum of 0"),
        ({"size": [2, 3], "counts": [8, -2]}, "counts from 0 on, got a run of -2"),
        ({"size": [2, 3], "counts": [1.0, 5]}, "a list of whole numbers or a string"),
        ({"size": [2, 3], "counts": {"0": 6}}, "a list of whole numbers or a string"),
        ({"size": [2, 3], "counts": "12"}, "got a sum of 3"),
        ({"size": [2, 3], "counts": "6O"}, "got a run of -1"),
        ({"size": [2, 3], "counts": "6P"}, "cut off within a number"),
        ({"size": [2, 3], "counts": "6 "}, "' ' in number 1"),
        ({"size": [2, 3], "counts": "6\u0660"}, "in number 1"),
        ({"size": [2, 3], "counts": "P" * 8 + "0"}, "7 at most for a number"),
    ],
)
def test_what_is_no_mask_is_refused(segmentation: Any, message: str) -> None:
    with pytest.raises(InvalidFeatures, match=message) as caught:
        read_runs(segmentation, "a.json mask 0")
    assert str(caught.value).startswith("a.json mask 0: ")
