"""JSON documents of masks by phrase: masks are read, and undecided pixels have no label."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from liftcore.errors import InvalidFeatures
from liftcore.features.mask_files import fill_polygons, read_polygons, read_runs
from liftcore.features.masks import mask_views
from liftcore.features.prompts import Prompts, prompt_views
from liftcore.values.views import NO_LABEL, Regions
from tests.run_lengths import sam_records, write_files

if TYPE_CHECKING:
    from pathlib import Path

HEIGHT, WIDTH = 6, 8
MUG, BOWL = np.zeros((2, HEIGHT, WIDTH), bool)
MUG[1:4, 1:4] = BOWL[2:5, 5:8] = True
CATEGORIES = [{"id": 1, "name": "red mug"}, {"id": 2, "name": "bowl"}]
UNDECIDED = "-"  # of a pixel without a label
MUG_POLYGON, BOWL_POLYGON = [[1, 1, 4, 1, 4, 4, 1, 4]], [[5, 2, 8, 2, 8, 5, 5, 5]]


def rle(mask: np.ndarray) -> dict[str, Any]:
    return sam_records(mask[None], as_string=True)[0]["segmentation"]


def coco(*masks: tuple[int, int, Any], images: int = 2, **entries: dict[str, Any]) -> dict[str, Any]:
    """Return a data set of images, annotated with (image, category, segmentation); entries add fields to an image."""
    image_records = [{"id": k, "file_name": f"{k}.jpg", "height": HEIGHT, "width": WIDTH} for k in range(images)]
    for image in image_records:
        image.update(entries.get(f"image_{image['id']}", {}))
    annotations = [
        {"image_id": image, "category_id": category, "segmentation": segmentation, "bbox": [1, 1, 3, 3]}
        for image, category, segmentation in masks
    ]
    return {"images": image_records, "annotations": annotations, "categories": CATEGORIES}


def write(folder: Path, **documents: Any) -> Path:
    """Write JSON documents by their names, ``__`` for a folder; arrays and images with the suffix behind ``_as_``."""
    parts = {name: name.partition("_as_") for name in documents}
    names = {name: f"{stem.replace('__', '/')}.{suffix or 'json'}" for name, (stem, _, suffix) in parts.items()}
    return write_files(folder, {names[name]: content for name, content in documents.items()})


def label_rows(prompts: Prompts, view: str) -> list[str]:
    """Return the rows of a view, a letter a pixel: the first one of its phrase, ``.`` for none, UNDECIDED."""
    regions = prompts.views[view]
    assert isinstance(regions, Regions)
    letters = [word[0] for word in prompts.table.words] + ["."]
    channels = regions.codebook.numpy().argmax(axis=1)
    top = regions.labels.numpy().max(axis=0)
    top = np.broadcast_to(top, (HEIGHT, WIDTH)) if top.size == 1 else top
    return ["".join(UNDECIDED if k == NO_LABEL else letters[channels[k]] for k in row) for row in top]


def drawing(mug: np.ndarray, bowl: np.ndarray, rest: str = ".") -> list[str]:
    letters = np.where(mug, "r", np.where(bowl, "b", rest))
    return ["".join(row) for row in letters]


BOTH_MASKS, NO_MASKS = drawing(MUG, BOWL), drawing(MUG & BOWL, MUG & BOWL)


def test_images_that_nobody_annotated_are_left_out_unless_they_are_negatives(tmp_path: Path) -> None:
    folder = write(tmp_path, a=coco((0, 1, rle(MUG)), (0, 2, rle(BOWL)), images=5))
    prompts = prompt_views(folder)
    assert [*prompts.views] == ["0"] and label_rows(prompts, "0") == BOTH_MASKS
    assert any("4 of 5 images of a.json" in warning for warning in prompts.warnings)
    prompts = prompt_views(folder, unannotated="negative")
    assert [*prompts.views] == ["0", "1", "2", "3", "4"] and not prompts.warnings
    assert label_rows(prompts, "3") == NO_MASKS


def test_a_file_a_phrase_decides_its_own_phrase_alone(tmp_path: Path) -> None:
    mug, bowl = coco((0, 1, rle(MUG))), coco((0, 2, rle(BOWL)), (1, 2, rle(BOWL)))
    mug["categories"], bowl["categories"] = CATEGORIES[:1], CATEGORIES[1:]
    prompts = prompt_views(write(tmp_path, mug=mug, bowl=bowl))
    assert label_rows(prompts, "0") == BOTH_MASKS
    assert label_rows(prompts, "1") == drawing(MUG & BOWL, BOWL, UNDECIDED)


def test_polygons_and_run_lengths_of_one_image_are_masks_alike(tmp_path: Path) -> None:
    parts = [[1, 1, 4, 1, 4, 2, 1, 2], [1, 2, 4, 2, 4, 4, 1, 4], [1, 1, 2, 1, 2, 4, 1, 4], [3, 3, 3, 3]]
    prompts = prompt_views(
        write(
            tmp_path,
            a=coco((0, 1, parts), (0, 2, rle(BOWL)), (1, 1, MUG_POLYGON), (1, 2, [5.0, 2, 8, 2, 8, 5, 5, 5])),
        )
    )
    assert label_rows(prompts, "0") == label_rows(prompts, "1") == BOTH_MASKS


def test_polygons_are_filled_as_coco_fills_them() -> None:
    """Masks equal those of pycocotools 2.0.11 (``frPyObjects``, ``merge``) within a pixel of the outline."""
    cases = [
        ([[2.3, 1.2, 10.7, 2.1, 8.4, 9.6]], "U12:100O2N1O1OM3MU1"),
        ([[1, 1, 9, 1, 9, 9, 1, 9], [5.5, 4.5, 12.5, 4.5, 12.5, 11, 5.5, 11]], "=84000000002N0004L0000007"),
        ([[-3, -2, 20, 3.5, 6, 18]], "0662N2NV1OkN0000001O0O1OO"),  # cut off by the image
        ([[2, 2, 12, 10, 12, 2, 2, 10]], "j085N2N2Ni00WO2N2N2e0"),  # crosses itself
    ]
    for polygon, counts in cases:
        size = (12, 14)
        actual = fill_polygons(size, read_polygons(polygon))
        expected = read_runs({"size": [*size], "counts": counts}).pixels()
        assert_within_a_pixel(actual, expected)
    corners = [[2.3, 1.2], [10.7, 2.1], [8.4, 9.6]]  # of the first, as the labels of LeRF-OVS have them
    first, second = (fill_polygons((12, 14), read_polygons(polygon)) for polygon in (corners, cases[0][0]))
    assert np.array_equal(first, second)


def assert_within_a_pixel(actual: np.ndarray, expected: np.ndarray) -> None:
    padded = np.pad(expected, 1, mode="edge")
    around = np.stack([padded[y : y + actual.shape[0], x : x + actual.shape[1]] for y in range(3) for x in range(3)])
    assert not (actual & ~around.any(axis=0)).any() and not (around.all(axis=0) & ~actual).any()


def test_polygons_beyond_their_image_are_reported(tmp_path: Path) -> None:
    corner = [[6, 4, 8.1, 4, 8.1, 6.1]]  # as drawn over the edge by hand
    tall = write(tmp_path / "tall", a=coco((0, 1, BOWL_POLYGON), image_0={"width": HEIGHT, "height": WIDTH}))
    assert any("swapped" in warning for warning in prompt_views(tall).warnings)
    small = write(tmp_path / "small", a=coco((0, 1, BOWL_POLYGON), image_0={"width": 4, "height": 3}))
    with pytest.raises(ValueError, match=r"1 polygons of a.json extend beyond their images"):
        prompt_views(small)  # which leaves no mask
    prompts = prompt_views(write(tmp_path / "whole", a=coco((0, 1, corner), (1, 2, BOWL_POLYGON))))
    assert not any("beyond" in warning for warning in prompts.warnings)


def test_boxes_without_a_mask_are_reported_and_decide_nothing(tmp_path: Path) -> None:
    folder = write(tmp_path, a=coco((0, 1, []), (0, 2, rle(BOWL)), (1, 1, MUG_POLYGON)))
    prompts = prompt_views(folder)
    box = [line[:1] + UNDECIDED * 3 + line[4:] for line in drawing(MUG & BOWL, BOWL)]
    assert label_rows(prompts, "0") == [
        box[k] if 1 <= k < 4 else line for k, line in enumerate(drawing(MUG & BOWL, BOWL))
    ]
    assert any("1 annotations of a.json" in warning for warning in prompts.warnings)
    with pytest.raises(ValueError, match=r"0 of 1 phrases; .*at most a box and no mask"):
        prompt_views(write(tmp_path / "boxes", a=coco((0, 1, []), (1, 1, []))))


@pytest.mark.parametrize("subfolder", [".", "json_data"])
@pytest.mark.parametrize("kind", ["npz", "png"])
def test_tracked_objects_are_masks_of_their_class_names(subfolder: str, kind: str, tmp_path: Path) -> None:
    """Grounded SAM 2: two objects of one class are one phrase, and the view is the image, without ``mask_``."""
    mug_parts = MUG.copy()
    mug_parts[2:] = False
    ids = (3 * BOWL + 1 * MUG + 1 * mug_parts).astype(np.uint16)
    names = {1: "red mug", 2: "red mug", 3: "bowl"}
    labels = {str(k): {"instance_id": k, "class_name": name, "logit": 0.0} for k, name in names.items()}
    document = {"mask_name": "mask_7.npy", "mask_height": HEIGHT, "mask_width": WIDTH, "labels": labels}
    empty = {**document, "mask_name": "mask_8.npy", "labels": {}}
    files = {f"mask_data__mask_7_as_{kind}": ids, f"mask_data__mask_8_as_{kind}": 0 * ids}
    folder = write(tmp_path, json_data__mask_7=document, json_data__mask_8=empty, **files)
    prompts = prompt_views(folder / subfolder)
    assert [*prompts.views] == ["7", "8"] and prompts.table.words == ("bowl", "red mug")
    assert (label_rows(prompts, "7"), label_rows(prompts, "8")) == (BOTH_MASKS, NO_MASKS)


def of_image(path: str, mask: np.ndarray = MUG) -> dict[str, Any]:
    annotations = [{"class_name": "red mug", "segmentation": rle(mask), "bbox": [1, 1, 4, 4]}]
    return {"image_path": path, "annotations": annotations, "img_width": WIDTH, "img_height": HEIGHT}


@pytest.mark.parametrize(
    ("paths", "views"),
    [
        (["notebooks/images/IMG_0.jpg", "notebooks/images/IMG_1.jpg"], ["IMG_0", "IMG_1"]),
        (["C:\\scene\\IMG_0.jpg", "C:\\scene\\IMG_1.jpg"], ["IMG_0", "IMG_1"]),
        (["/data/camA/000.jpg", "/data/camB/000.jpg"], ["camA/000", "camB/000"]),
        (["./a/000.jpg", "./b/c/000.jpg"], ["a/000", "b/c/000"]),
        (["Ku\u0308che.jpg", "Bad.jpg"], ["Bad", "K\u00fcche"]),
    ],
)
def test_a_document_of_an_image_is_of_the_view_that_it_names(
    paths: list[str], views: list[str], tmp_path: Path
) -> None:
    folder = write(tmp_path, **{f"{number}__results": of_image(path) for number, path in enumerate(paths)})
    assert {*prompt_views(folder).views} == {*views}


def test_masks_of_several_files_of_one_image_are_combined_with_a_warning(tmp_path: Path) -> None:
    prompts = prompt_views(write(tmp_path, mug__out=of_image("in.jpg"), bowl__out=of_image("in.jpg", BOWL)))
    assert label_rows(prompts, "in") == drawing(MUG | BOWL, MUG & BOWL)
    assert any("2 files are of one image, 'in'" in warning for warning in prompts.warnings)


def test_photos_beside_documents_that_name_them_are_no_masks(tmp_path: Path) -> None:
    """Roboflow exports photos under names of its own."""
    file_name = "0_jpg.rf.0123456789abcdef0123456789abcdef.jpg"
    content = coco((0, 1, MUG_POLYGON), images=1, image_0={"file_name": file_name})
    photo = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    folder = write(tmp_path, train___annotations_coco=content, train__0_as_png=photo)
    assert [*prompt_views(folder).views] == ["0"]
    twice = coco((0, 1, MUG_POLYGON), (1, 1, MUG_POLYGON))
    for image, end in zip(twice["images"], "ab", strict=True):
        image["file_name"] = f"0_jpg.rf.{end * 32}.jpg"
    with pytest.raises(ValueError, match=r"one image a photo.*augmentation"):
        prompt_views(write(tmp_path / "twice", a=twice))


def test_pixels_that_nobody_decided_have_no_label(tmp_path: Path) -> None:
    """The 255 of VOC and the like, in images of numbers, images with a palette and binary images."""
    void = np.zeros((HEIGHT, WIDTH), bool)
    void[0] = True
    expected = drawing(MUG, BOWL)
    expected[0] = UNDECIDED * WIDTH
    values = np.where(void, 255, 7 * MUG + 9 * BOWL).astype(np.uint8)
    palette = Image.fromarray(values)
    palette.putpalette([*range(256)] * 3)
    for kind in ("grey", "palette", "wide"):
        folder = tmp_path / kind
        folder.mkdir()
        wide_values = np.where(void, 65_535, values.astype(np.int32)).astype(np.uint16)
        picture = palette if kind == "palette" else Image.fromarray(wide_values if kind == "wide" else values)
        picture.save(folder / "a.png")
        (folder / "names.json").write_text('{"7": "red mug", "9": "bowl"}', encoding="utf-8")
        mark = 65_535 if kind == "wide" else 255
        with pytest.raises(InvalidFeatures, match=f"got the value {mark}; .*--unlabelled {mark}"):
            prompt_views(folder, folder / "names.json")
        assert label_rows(prompt_views(folder, folder / "names.json", unlabelled=mark), "a") == expected
    mug = np.where(void, 255, MUG).astype(np.uint8)
    folder = write(tmp_path / "binary", **{"red mug__a_as_png": mug})
    assert label_rows(prompt_views(folder, unlabelled=255), "a") == [UNDECIDED * WIDTH, *drawing(MUG, MUG & BOWL)[1:]]
    with pytest.raises(InvalidFeatures, match=r"^unlabelled:"):
        prompt_views(write(tmp_path / "json", a=coco((0, 1, MUG_POLYGON))), unlabelled=255)


def test_masks_with_vectors_may_be_polygons_or_have_a_unit_axis(tmp_path: Path) -> None:
    masks = np.stack([MUG, BOWL])
    records = [{"segmentation": MUG_POLYGON}, {"segmentation": rle(BOWL)}]
    kinds: list[dict[str, Any]] = [
        {"a": {"height": HEIGHT, "width": WIDTH, "annotations": records}},
        {"a_masks_as_npz": masks[None]},
        {"a_masks_as_npz": np.where(MUG, 0, np.where(BOWL, 1, -1))[None, None]},
    ]
    for number, files in enumerate(kinds):
        folder = write(tmp_path / str(number), **files, a_as_npy=np.eye(2, 5, dtype=np.float32))
        labels = mask_views(folder)["a"].labels[0].numpy()
        assert np.array_equal(labels, np.where(MUG, 0, np.where(BOWL, 1, -1)))


@pytest.mark.parametrize(
    "document",
    [
        {"shapes": [{"label": "mug", "points": [[1, 1], [4, 1], [4, 4]]}], "imagePath": "a.jpg"},
        {"videos": [{"id": 1, "file_names": ["a.jpg"]}], "annotations": [{"segmentations": [None]}]},
        {"annotations": [{"file_name": "a.png", "segments_info": [{"id": 1, "category_id": 1}]}]},
        {"mask_name": "a.npy", "labels": {"1": []}},
    ],
)
def test_json_of_other_programs_is_refused_with_what_to_export(document: Any, tmp_path: Path) -> None:
    with pytest.raises(InvalidFeatures, match=r"a\.json.*export COCO's JSON"):
        prompt_views(write(tmp_path, a=document))
