"""Masks with a vector each become region maps, the same from every kind of file, or are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from liftcore.errors import InvalidFeatures
from liftcore.features.mask_files import read_runs
from liftcore.features.masks import mask_views
from liftcore.values.pack import read_features, write_pack
from liftcore.values.views import MAX_LEVELS, Regions, label_levels
from tests.run_lengths import compressed, lengths_of, sam_records, write_files

LABELS = np.array([[-1, 0, 0, 2], [1, 1, -1, 2], [1, 1, -1, -1]])
MASKS = np.stack([k == LABELS for k in range(3)])
VECTORS = np.arange(15, dtype=np.float32).reshape(3, 5)


GREY = (LABELS + 1).astype(np.uint8)
PALETTE = Image.fromarray(GREY)
PALETTE.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])


KINDS: dict[str, dict[str, Any]] = {
    "grey of 8 bits": {"a.png": GREY},
    "grey of 16 bits": {"a.png": GREY.astype(np.uint16)},
    "palette": {"a.png": PALETTE},
    "ids": {"a_masks.npy": LABELS},
    "booleans": {"a_masks.npy": MASKS},
    "uncompressed_rle": {"a.json": sam_records(MASKS)},
    "coco_rle": {"a.json": sam_records(MASKS, as_string=True)},
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_masks_makes_the_same_regions(kind: str, tmp_path: Path) -> None:
    write_files(tmp_path, {"a.npy": VECTORS, **KINDS[kind]})
    write_pack(tmp_path / "pack.safetensors", mask_views(tmp_path), {})
    packs = read_features(tmp_path / "pack.safetensors")
    assert packs.views == ("a",)
    view = packs["a"]
    assert isinstance(view, Regions)
    assert view.labels.tolist() == [LABELS.tolist()]
    assert view.codebook.tolist() == VECTORS.tolist()


def test_views_are_named_as_their_cameras_are_and_with_their_folders(tmp_path: Path) -> None:
    write_files(tmp_path, {f"{name}.npy": VECTORS for name in ("a.jpg", "frame.0001", "c", "camA/0")})
    write_files(tmp_path, {"a.jpg_masks.npy": MASKS, "camA/0_masks.npy": MASKS, "c.PNG": GREY})
    write_files(tmp_path, {"frame.0001.json": sam_records(MASKS)})
    write_files(tmp_path, {"notes.txt": "passed over", ".thumbnails/0.png": b"no mask"})
    views = mask_views(tmp_path)
    assert [*views] == ["a", "c", "camA/0", "frame.0001"]
    assert {views[view].labels.tolist() == [LABELS.tolist()] for view in views} == {True}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ("a.npy", r"masks in a\.json, a_masks\.npy or a\.png, got a\.npy alone"),
        ("a_f.npy a_s.npy", r"a_f\.npy alone; .*'splatlift pack langsplat'"),
        ("a_masks.npy", r"vectors in a\.npy, got a_masks\.npy alone"),
        ("a.npy a.json a.png", r"one file of masks a view, got a\.json and a\.png.*move photos to another folder"),
    ],
)
def test_files_without_their_partners_are_refused(files: str, message: str, tmp_path: Path) -> None:
    write_files(tmp_path, dict.fromkeys(files.split(), b"not opened yet"))
    with pytest.raises(ValueError, match=message):
        mask_views(tmp_path)


def test_values_that_begin_at_one_are_refused_where_zero_was_expected(tmp_path: Path) -> None:
    write_files(tmp_path, {"a.npy": VECTORS, "a.png": GREY})
    message = r"values 0\.\.2 for 3 vectors, and 255 for none, got the value 3; .*--unlabelled 0"
    with pytest.raises(InvalidFeatures, match=message):
        mask_views(tmp_path, 255)["a"]


def mask_of(segmentation: Any) -> np.ndarray:
    return read_runs(segmentation).pixels()


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
        ([[1.0, 2.0, 3.0, 4.0]], r"run lengths \{size, counts\}, got \[\[1\.0, 2\.0, 3\.0, 4\.0\]\]; .*output_mode"),
        ({"size": [32769, 1], "counts": [32769]}, r"sides in 1\.\.32768"),
        ({"size": [32768, 32768], "counts": [1 << 30]}, "at most 178956970 pixels"),
        ({"size": [2, 3], "counts": [1, 2]}, r"sum up to 2 x 3 = 6, got a sum of 3; the file is truncated"),
        ({"size": [2, 3], "counts": [8, -2]}, "counts from 0 on, got a run of -2"),
        ({"size": [2, 3], "counts": "6P"}, "ends within a number"),
        ({"size": [2, 3], "counts": "P" * 8 + "0"}, "7 at most for a number"),
    ],
)
def test_what_is_no_mask_is_refused(segmentation: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_runs(segmentation)


@st.composite
def boxes(draw: st.DrawFn) -> np.ndarray:
    """Generate masks [K, 9, 12] bool: boxes and their differences, some empty."""
    masks = np.zeros((draw(st.integers(1, 12)), 9, 12), bool)
    for mask in masks:
        for value in (True, False):
            top, left = draw(st.integers(0, 8)), draw(st.integers(0, 11))
            mask[top : top + draw(st.integers(0, 9)), left : left + draw(st.integers(0, 12))] = value
    return masks


@given(boxes())
def test_every_mask_is_whole_on_one_level(masks: np.ndarray) -> None:
    labels = label_levels(list(masks))
    assert labels.dtype == np.int32 and labels.shape[1:] == masks.shape[1:]
    for number, mask in enumerate(masks):
        level_mask = labels == number
        assert np.array_equal(level_mask.any(axis=0), mask)
        assert level_mask.any(axis=(1, 2)).sum() == mask.any()
    assert all((level >= 0).any() for level in labels[1:])
    largest = masks.sum(axis=(1, 2)).argmax()
    assert np.array_equal(labels[0] == largest, masks[largest]), "the largest comes first"


def test_too_many_masks_over_a_pixel_are_refused_with_their_number() -> None:
    masks = [np.ones((2, 2), bool)] * MAX_LEVELS
    assert len(label_levels(masks)) == MAX_LEVELS
    with pytest.raises(ValueError, match=r"33 masks, up to 33 of them over one pixel; .*box_nms_thresh"):
        label_levels([*masks, np.ones((2, 2), bool)])
