"""Masks with a vector each become region maps, the same from every kind of file, or are refused by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from liftcore.errors import InvalidFeatures
from liftcore.features.mask_files import mask_of_runs, read_runs
from liftcore.features.masks import MAX_LEVELS, layered, mask_views
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions
from tests.run_lengths import compressed, lengths_of, sam_records

LABELS = np.array([[-1, 0, 0, 2], [1, 1, -1, 2], [1, 1, -1, -1]])
MASKS = np.stack([k == LABELS for k in range(3)])
VECTORS = np.arange(15, dtype=np.float32).reshape(3, 5)
OVERLAPPING = np.stack([MASKS[0] | MASKS[1], MASKS[1], MASKS[2]])


def save_picture(path: Path, values: np.ndarray, mode: str = "") -> None:
    image = Image.fromarray(values)
    if mode == "P":
        image.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    image.save(path)


def save_text(path: Path, content: object) -> None:
    path.write_text(json.dumps(content), encoding="utf-8")


def palette(folder: Path) -> None:
    save_picture(folder / "a.png", (LABELS + 1).astype(np.uint8), "P")


WRITERS = {
    "grey of 8 bits": lambda folder: save_picture(folder / "a.png", (LABELS + 1).astype(np.uint8)),
    "grey of 16 bits": lambda folder: save_picture(folder / "a.png", (LABELS + 1).astype(np.uint16)),
    "palette": palette,
    "ids": lambda folder: np.save(folder / "a_masks.npy", LABELS),
    "ids on a level": lambda folder: np.save(folder / "a_masks.npy", LABELS[None].astype(np.int16)),
    "ids as floats": lambda folder: np.save(folder / "a_masks.npy", LABELS.astype(np.float32)),
    "booleans": lambda folder: np.save(folder / "a_masks.npy", MASKS),
    "booleans down the columns": lambda folder: np.save(folder / "a_masks.npy", np.asfortranarray(MASKS)),
    "uncompressed_rle": lambda folder: save_text(folder / "a.json", sam_records(MASKS)),
    "coco_rle": lambda folder: save_text(folder / "a.json", sam_records(MASKS, as_string=True)),
    "SA-1B": lambda folder: save_text(
        folder / "a.json", {"image": {"image_id": 1}, "annotations": sam_records(MASKS, as_string=True)}
    ),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_kind_of_masks_makes_the_same_regions(kind: str, tmp_path: Path) -> None:
    WRITERS[kind](tmp_path)
    np.save(tmp_path / "a.npy", VECTORS)
    write_pack(tmp_path / "pack.safetensors", mask_views(tmp_path), {})
    packs = read_features(tmp_path / "pack.safetensors")
    assert packs.views == ("a",)
    view = packs["a"]
    assert isinstance(view, Regions)
    assert view.labels.tolist() == [LABELS.tolist()]
    assert view.codebook.tolist() == VECTORS.tolist()


@pytest.mark.parametrize(
    ("unlabelled", "dtype"), [(255, np.uint8), (65_535, np.uint16), (255, np.uint16), (3, np.uint8)]
)
def test_pictures_with_another_value_for_none_number_masks_from_zero(unlabelled, dtype, tmp_path: Path) -> None:
    save_picture(tmp_path / "a.png", np.where(LABELS < 0, unlabelled, LABELS).astype(dtype))
    np.save(tmp_path / "a.npy", VECTORS)
    assert mask_views(tmp_path, unlabelled)["a"].labels.tolist() == [LABELS.tolist()]


@pytest.mark.parametrize("kind", ["booleans", "rle"])
def test_masks_that_overlap_are_laid_on_levels(kind: str, tmp_path: Path) -> None:
    if kind == "booleans":
        np.save(tmp_path / "a_masks.npy", OVERLAPPING)
    else:
        save_text(tmp_path / "a.json", sam_records(OVERLAPPING))
    np.save(tmp_path / "a.npy", VECTORS.astype(np.float16))
    first = np.where(OVERLAPPING[0], 0, np.where(OVERLAPPING[2], 2, -1))
    second = np.where(OVERLAPPING[1], 1, -1)
    assert mask_views(tmp_path)["a"].labels.tolist() == [first.tolist(), second.tolist()]


def test_views_are_named_as_their_cameras_are_and_with_their_folders(tmp_path: Path) -> None:
    for name in ("a.jpg", "frame.0001", "c", "camA/0"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        np.save(tmp_path / f"{name}.npy", VECTORS)
    for name in ("a.jpg", "camA/0"):
        np.save(tmp_path / f"{name}_masks.npy", MASKS)
    save_text(tmp_path / "frame.0001.json", sam_records(MASKS))
    save_picture(tmp_path / "c.PNG", (LABELS + 1).astype(np.uint8))
    (tmp_path / "notes.txt").write_text("passed over", encoding="utf-8")
    (tmp_path / ".thumbnails").mkdir()
    (tmp_path / ".thumbnails" / "0.png").write_bytes(b"no mask")
    views = mask_views(tmp_path)
    assert [*views] == ["a", "c", "camA/0", "frame.0001"]
    assert {views[view].labels.tolist() == [LABELS.tolist()] for view in views} == {True}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (("a.npy",), r"masks in a\.json, a_masks\.npy or a\.png, got a\.npy alone"),
        (
            ("a_f.npy", "a_s.npy"),
            r"got a_f\.npy alone; folders of LangSplat are packed by 'splatlift pack langsplat'",
        ),
        (("a.npy", "a.json", "b.json"), r"vectors in b\.npy, got b\.json alone; .*belong in another folder"),
        (("a_masks.npy",), r"vectors in a\.npy, got a_masks\.npy alone"),
        (("a.npy", "a.json", "a.png"), r"one file of masks a view, got a\.json and a\.png.*photos belong"),
        (("a.npy", "a.jpg.npy", "a.json"), r"one file of vectors a view, got a\.jpg\.npy and a\.npy, both of"),
        (("a.json",), r"\*\.npy files"),
        (("a.pt",), "pickles"),
    ],
)
def test_files_without_their_partners_are_told(files: tuple[str, ...], message: str, tmp_path: Path) -> None:
    for name in files:
        (tmp_path / name).write_bytes(b"not opened yet")
    with pytest.raises(InvalidFeatures, match=message):
        mask_views(tmp_path)


@pytest.mark.parametrize(
    ("vectors", "message"),
    [
        (np.zeros(3, np.float32), r"floats \[M, F\]"),
        (np.zeros((3, 5), np.int32), r"floats \[M, F\], got int32"),
        (np.array([[None]], dtype=object), "Python objects, which may run code"),
        (VECTORS[:2], r"ids in -1\.\.1, got ids from -1 to 2"),
        (np.where(VECTORS == 7, np.nan, VECTORS), r"view 'a' codebook.*1 of 15"),
        (np.where(VECTORS == 7, 1e300, VECTORS.astype(np.float64)), r"view 'a' codebook.*1 of 15"),
    ],
)
def test_vectors_that_do_not_fit_are_refused(vectors: np.ndarray, message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a_masks.npy", LABELS)
    np.save(tmp_path / "a.npy", vectors)
    with pytest.raises(InvalidFeatures, match=message):
        write_pack(tmp_path / "pack", mask_views(tmp_path), {})
    assert not (tmp_path / "pack").exists()


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        (MASKS[:2], r"3 masks, one a vector, got bool \[2, 3, 4\]; row k of the vectors is of mask k"),
        (
            OVERLAPPING.transpose(2, 0, 1),
            r"got bool \[4, 3, 3\]; row k .*, and masks come first: \[M, H, W\]",
        ),
        (MASKS[0], r"booleans \[M, H, W\], got bool \[3, 4\]"),
        (MASKS.astype(np.uint8), r"zeros and ones; .*astype\(bool\)"),
        (np.full((3, 4), 3), r"ids in -1\.\.2"),
        (np.full((3, 4), 255, np.uint8), r"got ids from 255 to 255"),
        (np.full((3, 4), 0.5), "whole numbers"),
        (np.zeros((1, 1, 3, 4), np.int32), r"mask ids \[L, H, W\]"),
        (np.array([{}], dtype=object), "Python objects, which may run code"),
        (np.array(["a"]), "an array of numbers"),
    ],
)
def test_arrays_that_are_no_masks_are_refused(masks: np.ndarray, message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a_masks.npy", masks)
    np.save(tmp_path / "a.npy", VECTORS)
    with pytest.raises(InvalidFeatures, match=message) as caught:
        mask_views(tmp_path)["a"]
    assert "a_masks.npy" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no JSON"),
        ('[{"segmentation": {"size": [3', "no JSON"),
        ("[" * 100_000, "no JSON"),
        ("3", r"a list of masks, or \{'annotations': \[\.\.\.\]\}, got none"),
        ('{"frames": [], "w": 3}', "an object of 'frames', 'w'; files of no views belong elsewhere"),
        ("[]", "3 masks, one a vector, got 0; leave out views without masks"),
        (json.dumps(sam_records(MASKS[:2])), "3 masks, one a vector, got 2; row k of the vectors is of mask k"),
        (json.dumps([*sam_records(MASKS[:2]), 3]), r"a\.json mask 2: expected run lengths"),
        (
            json.dumps([*sam_records(MASKS[:2]), *sam_records(MASKS[2:, :2])]),
            "one size, got 3 x 4 of mask 0 and 2 x 4 of mask 2",
        ),
    ],
)
def test_json_that_holds_no_such_masks_is_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(content, encoding="utf-8")
    np.save(tmp_path / "a.npy", VECTORS)
    with pytest.raises(InvalidFeatures, match=message) as caught:
        mask_views(tmp_path)["a"]
    assert "a.json" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "unlabelled", "message"),
    [
        (LABELS + 2, 0, r"values 1\.\.3 for 3 vectors, and 0 for none, got values up to 4; name the value"),
        (np.where(LABELS < 0, 255, LABELS), 0, r"got values up to 255; .*--unlabelled \(255, 65535\)"),
        (LABELS.clip(0), 0, r"got values up to 2; is there a vector for 0 too"),
        (np.zeros((3, 4)), 0, "got values up to 0"),
        (LABELS + 1, 255, r"values 0\.\.2 for 3 vectors, and 255 for none, got the value 3; .*--unlabelled 0"),
    ],
)
def test_values_that_do_not_end_with_the_vectors_are_refused(
    values: np.ndarray, unlabelled: int, message: str, tmp_path: Path
) -> None:
    save_picture(tmp_path / "a.png", values.astype(np.uint8))
    np.save(tmp_path / "a.npy", VECTORS)
    with pytest.raises(InvalidFeatures, match=message):
        mask_views(tmp_path, unlabelled)["a"]


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("RGB", "red, green and blue of 8 bits; a photo belongs in another folder"),
        ("RGBA", "colours with transparency of 8 bits"),
        ("LA", "grey with transparency of 8 bits"),
        ("1", "grey of 1 bits"),  # Pillow spreads fewer bits of grey over 0 to 255
    ],
)
def test_pictures_of_other_kinds_are_refused(mode: str, message: str, tmp_path: Path) -> None:
    Image.new(mode, (4, 3)).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", VECTORS)
    with pytest.raises(InvalidFeatures, match=message):
        mask_views(tmp_path)["a"]


@pytest.mark.parametrize("kept", [0, 30, 60, 2000])
def test_pictures_that_are_cut_off_are_refused(kept: int, tmp_path: Path) -> None:
    save_picture(tmp_path / "a.png", np.random.default_rng(0).integers(0, 4, (128, 128), np.uint8))
    content = (tmp_path / "a.png").read_bytes()
    assert len(content) > 4000
    (tmp_path / "a.png").write_bytes(content[:kept])
    np.save(tmp_path / "a.npy", VECTORS)
    with pytest.raises(InvalidFeatures, match=r"a\.png: expected a PNG of one channel"):
        mask_views(tmp_path)["a"]


def test_files_beyond_the_limits_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    palette(tmp_path)
    np.save(tmp_path / "a.npy", VECTORS)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 11)
    assert mask_views(tmp_path)["a"].labels.tolist() == [LABELS.tolist()]
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 5)
    with pytest.raises(InvalidFeatures, match="at most 10 pixels, got a larger picture"):
        mask_views(tmp_path)["a"]
    (tmp_path / "a.png").unlink()
    monkeypatch.setattr("liftcore.features.mask_files.MAX_JSON_BYTES", 10)
    save_text(tmp_path / "a.json", sam_records(MASKS))
    with pytest.raises(InvalidFeatures, match=r"at most 10 bytes, got \d+ bytes; .*coco_rle"):
        mask_views(tmp_path)["a"]


def test_one_mask_over_the_whole_photo_is_one(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VECTORS[:1])
    np.save(tmp_path / "a_masks.npy", np.zeros((1, 3, 4), np.int32))
    assert not mask_views(tmp_path)["a"].labels.any()


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
        ({"size": [2, 3, 1], "counts": [6]}, r"size \[h, w\], got \[2, 3, 1\]"),
        ({"size": [2.0, 3], "counts": [6]}, r"size \[h, w\]"),
        ({"size": [0, 3], "counts": [0]}, r"sides in 1\.\.32768"),
        ({"size": [32769, 1], "counts": [32769]}, r"sides in 1\.\.32768"),
        ({"size": [32768, 32768], "counts": [1 << 30]}, "at most 178956970 pixels"),
        ({"size": [2, 3], "counts": [1, 2]}, r"sum up to 2 x 3 = 6, got a sum of 3; the file is cut off"),
        ({"size": [2, 3], "counts": [1, 2, 10**30]}, "sum up to 2 x 3"),
        ({"size": [2, 3], "counts": []}, "got a sum of 0"),
        ({"size": [2, 3], "counts": [8, -2]}, "counts from 0 on, got a run of -2"),
        ({"size": [2, 3], "counts": [1.0, 5]}, "a list of whole numbers or a string"),
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
