"""JSON documents of masks by phrase: their images, the masks, and the phrases that were searched for.

- COCO's data set, ``images``, ``annotations`` and ``categories``. An image without an annotation is either not
  annotated yet or empty, and programs export both in the same way (Label Studio, Roboflow, CVAT). Only two kinds of
  file say that a phrase is absent: SA-Co's, where each image has a ``text_input`` that was searched for, and LVIS's,
  by ``neg_category_ids``; there ``not_exhaustive_category_ids`` are partly annotated.
- Videos of YouTube-VIS and SA-Co, ``videos`` with a ``segmentations`` entry for each frame.
- Records of one image, a list or under one of `RECORD_LISTS`, as Grounded SAM 2, LabelMe or ISAT write them; the
  document may name the image (``image_path``).
- Objects by the ids of a picture of numbers: Grounded SAM 2's tracking (``mask_name`` and ``labels``, with the ids in
  ``mask_data``), and COCO's panoptic ``segments_info``, which DEVA writes too.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.mask_files import (
    MAX_COORDINATE,
    PolygonMask,
    StoredMask,
    check_size,
    mask_records,
    read_mask,
    read_mask_json,
)
from liftcore.scene.views import composed, without_image_suffix
from liftcore.text.table import normalize_text

PHRASE_KEYS = (
    *("phrase", "prompt", "text", "label", "class_name", "category_name", "text_input", "noun_phrase"),
    *("category", "class", "classTitle", "name"),
)  # of a record
IMAGE_KEYS = ("image_path", "imagePath", "file_name")  # of the document of an image
SIZE_KEYS = (
    *(("img_height", "img_width"), ("imageHeight", "imageWidth"), ("imgHeight", "imgWidth"), ("height", "width")),
)
ISAT_BACKGROUND = "__background__"
TRACKED_PREFIX = "mask_"  # of Grounded SAM 2, before the name of the image
AS_COCO = "export COCO's JSON (instances)"
VOID = None  # in place of a phrase: pixels that are unlabelled
# Roboflow's name of a photo: IMG_0000_jpg.rf.0123456789abcdef0123456789abcdef.jpg of IMG_0000.jpg.
ROBOFLOW = re.compile(r"_(?:jpe?g|png|bmp|webp|tiff?|heic|avif|mpo|dng)\.rf\.[0-9A-Za-z_-]+(?=\.[a-z]+$)", re.I)
# Label Studio's name of a photo: 1f2e3d4c-IMG_0000.jpg.
LABEL_STUDIO = re.compile(r"^[0-9a-f]{8}-(?=.)")

Masks = list[tuple[str | None, StoredMask]]


@dataclass
class ImageMasks:
    """Masks of an image in a document, or of a pair of an image and a phrase."""

    image: str | None  # its path in the document; None: the image has the name of the document
    masks: Masks = field(default_factory=list)  # by phrase; VOID for unlabelled pixels
    phrases: list[str] = field(default_factory=list)  # of all records, also those without a mask
    searched: set[str] = field(default_factory=set)  # normalized phrases, all of whose objects have a mask
    # Normalized phrases that were not searched for, or not completely.
    not_searched: set[str] = field(default_factory=set)
    annotated: bool = True  # has a record, or is listed as empty
    ids: "IdObjects | None" = None  # objects of a picture of ids
    in_data_set: bool = False  # among the images of a data set
    file: str = ""  # its file name in a data set


@dataclass(frozen=True)
class IdObjects:
    """Objects by the ids of a picture or an array of numbers."""

    name: str  # of its file, possibly with another suffix
    phrases: dict[int, str | None]  # id -> phrase, or VOID


@dataclass
class MaskDocument:
    """The images of a document, with counts for warnings."""

    path: Path
    images: list[ImageMasks]
    boxes: int = 0  # records that have a box and no mask
    polygons: list[PolygonMask] = field(default_factory=list)  # of all records

    def beyond(self) -> int:
        """Count the polygons that extend beyond their images.

        Raises:
            InvalidFeatures: with width and height swapped, no polygon of images of one size would.
        """
        by_size: dict[tuple[int, int], list[PolygonMask]] = {}
        for polygon in self.polygons:
            by_size.setdefault(polygon.size, []).append(polygon)
        count = 0
        for (height, width), polygons in by_size.items():
            beyond = sum(polygon.reaches_beyond((height, width)) for polygon in polygons)
            if beyond and not any(polygon.reaches_beyond((width, height)) for polygon in polygons):
                got = f"{beyond} of {len(polygons)} that fit only {height} x {width}"
                hint = "width and height are swapped: write those of the annotated photos"
                expected = f"polygons within images of {width} x {height} pixels"
                raise InvalidFeatures(str(self.path), expected=expected, got=got, hint=hint)
            count += beyond
        return count

    def has_ids(self) -> bool:
        """Return True if objects are given by ids, which are in other files."""
        return any(image.ids is not None for image in self.images)


def read_mask_document(path: Path, names: Mapping[int, str], *, unannotated_negative: bool = False) -> MaskDocument:
    """Read a JSON document of masks by phrase.

    Args:
        names: phrases of categories by number, for documents without names of categories (DEVA).
        unannotated_negative: images without an annotation show none of the document's phrases.

    Raises:
        InvalidFeatures: not such a document, or a record without a phrase, of an unknown image, or with a malformed
            mask.
    """
    content = read_mask_json(path)
    if (other := _other_program(content)) is not None:
        expected, got = "COCO's JSON, or records with masks and phrases", other[0]
        raise InvalidFeatures(str(path), expected=expected, got=got, hint=other[1])
    document = MaskDocument(path, [])
    if isinstance(content, dict) and isinstance(content.get("labels"), dict) and "mask_name" in content:
        document.images = [_tracked(content, path)]
    elif isinstance(content, dict) and isinstance(content.get("videos"), list):
        document.images = _data_set(_frames(content, path), document, unannotated_negative=True)
    elif any(isinstance(item, dict) and "segments_info" in item for item in mask_records(content, path)):
        document.images = [*_panoptic(content, path, names)]
    elif isinstance(content, dict) and isinstance(content.get("images"), list):
        document.images = _data_set(content, document, unannotated_negative=unannotated_negative)
    else:
        image, size = _stated_image(content), declared_size(content)
        document.images = [image_masks := ImageMasks(image)]
        for number, record in enumerate(mask_records(content, path)):
            _add_record(image_masks, record, size, document, f"{path} mask {number}", {})
    return document


def _other_program(content: Any) -> tuple[str, str] | None:
    """Return the name of a format that is not read, and the advice; None for other documents."""
    first = next(iter(content if isinstance(content, list) else content.values()), None) if content else None
    first = first if isinstance(first, dict) else {}
    fields = content if isinstance(content, dict) else {}
    if "_via_img_metadata" in fields or {"filename", "regions"} <= first.keys():
        return "annotations of VGG Image Annotator, which have no size of their images", f"{AS_COCO} from it"
    if isinstance(content, list) and "data" in first and {"annotations", "completions"} & first.keys():
        return "tasks of Label Studio", f"{AS_COCO} from it"
    if "items" in fields and "categories" in fields:
        return "a data set of Datumaro", f"{AS_COCO}: datum convert -f coco_instances"
    if isinstance(content, list) and {"value", "label"} == first.keys():
        hint = "take Grounded SAM 2, or write each mask as PHRASE/VIEW.png"
        return "the names of Grounded SAM's mask.jpg, a picture in colours that has lost their ids", hint
    return None


def declared_size(content: Any) -> tuple[int, int] | None:
    """Return height and width of an image from a document or its entries; None if they are missing."""
    if not isinstance(content, dict):
        return None
    slots = content["item"].get("slots") if isinstance(content.get("item"), dict) else None  # of Darwin
    first = slots[:1] if isinstance(slots, list) else []
    for source in (content, *(content.get(key) for key in ("image", "info", "size")), *first):
        for keys in SIZE_KEYS:
            height, width = (_side(source.get(key) if isinstance(source, dict) else None) for key in keys)
            if height is not None and width is not None:
                return height, width
    return None


def _side(value: Any) -> int | None:
    """Return a whole number of pixels, also from a text; None for other values."""
    value = int(value) if isinstance(value, str) and value.isdecimal() and len(value) < 10 else value
    is_whole = isinstance(value, int | float) and not isinstance(value, bool) and value % 1 == 0
    return int(value) if is_whole else None


def image_of(name: str) -> str:
    """Return a photo's original name from a name by Roboflow; other names unchanged."""
    return ROBOFLOW.sub("", name)


def _stated_image(content: Any) -> str | None:
    if not isinstance(content, dict):
        return None
    image, info = content.get("image"), content.get("info")
    names = [content.get(key) for key in IMAGE_KEYS]
    names += [image, *(image.get(key) for key in ("file_name", "path"))] if isinstance(image, dict) else [image]
    names += [entry.get("name") for entry in (info, content.get("item")) if isinstance(entry, dict)]
    return next((name for name in names if isinstance(name, str) and name.strip()), None)


def _phrase_of(record: Mapping[str, Any], category: Mapping[str, Any], image: Mapping[str, Any]) -> str | None:
    candidates = (*map(record.get, PHRASE_KEYS), image.get("text_input"), category.get("name"))
    return next((phrase for phrase in candidates if isinstance(phrase, str)), None)


def _add_record(
    image_masks: ImageMasks,
    record: Any,
    size: tuple[int, int] | None,
    document: MaskDocument,
    location: str,
    category: Mapping[str, Any],
    image: Mapping[str, Any] | None = None,
) -> None:
    """Add a record of a mask to its image. The pixels of a box without a mask become unlabelled."""
    if not isinstance(record, dict):
        raise InvalidFeatures(location, expected="a mask with a phrase", got=type(record).__name__)
    # Boxes of LabelMe have two points, opposite corners.
    is_box = record.get("shape_type") not in (None, "polygon", "mask", "circle")
    mask = None if is_box else read_mask(record, size, location)
    phrase = _phrase_of(record, category, image or {})
    if phrase is None:
        expected, hint = (
            f"a phrase ({', '.join(PHRASE_KEYS[:5])} or a category)",
            "'splatlift pack masks' needs no phrases",
        )
        if "category_id" in record:
            hint = "write results of COCO as 'annotations' of a JSON with its 'images' and 'categories'"
            raise InvalidFeatures(location, expected=expected, got="a category_id without categories", hint=hint)
        raise InvalidFeatures(location, expected=expected, got="none", hint=hint)
    if phrase == ISAT_BACKGROUND:
        return
    image_masks.phrases.append(phrase)
    if mask is not None:
        document.polygons += [mask] if isinstance(mask, PolygonMask) else []
        if not mask.is_empty():
            image_masks.masks.append((phrase, mask))
        return
    document.boxes += 1
    box = _box(record.get("points") if is_box else record.get("bbox"), corners=is_box)
    if box is None or size is None:
        image_masks.not_searched.add(normalize_text(phrase))
    else:
        check_size(size, location)
        image_masks.masks.append((VOID, PolygonMask(size, (box,))))


def _box(sides: Any, *, corners: bool) -> Any:
    """Return the corners [4, 2] f64 of a box (x, y, width, height) or of two opposite corners; None if invalid."""
    try:
        numbers = np.array(sides, np.float64).reshape(2, 2)
    except (TypeError, ValueError, OverflowError):
        return None
    (x, y), (right, bottom) = numbers if corners else (numbers[0], numbers.sum(axis=0))
    return (
        np.array([[x, y], [right, y], [right, bottom], [x, bottom]])
        if (np.abs(numbers) <= MAX_COORDINATE).all()
        else None
    )


def _data_set(content: Mapping[str, Any], document: MaskDocument, *, unannotated_negative: bool) -> list[ImageMasks]:
    """Read the images of a COCO data set."""
    path = document.path
    images, categories = _by_id(content, "images"), _by_id(content, "categories")
    by_number = {
        number: ImageMasks(_image_name(image, path), in_data_set=True, file=_file_of(image))
        for number, image in images.items()
    }
    _drop_upload_prefixes([*by_number.values()])
    for number, record in enumerate(mask_records(content, path)):
        location = f"{path} mask {number}"
        if not isinstance(record, dict):
            raise InvalidFeatures(location, expected="a mask with a phrase", got=type(record).__name__)
        image = _id(record, "image_id")
        if image not in by_number:
            raise InvalidFeatures(location, expected="an image_id of the file", got=repr(image)[:80])
        size, category = declared_size(images[image]), categories.get(_id(record, "category_id"), {})
        _add_record(by_number[image], record, size, document, location, category, images[image])
    category_names = {
        other: category["name"] for other, category in categories.items() if isinstance(category.get("name"), str)
    }
    questions = {number: image["text_input"] for number, image in images.items() if _has_prompt(image)}
    masked = [phrase for image_masks in by_number.values() for phrase in image_masks.phrases]
    phrases = {
        normalize_text(phrase)
        for phrase in [*masked, *questions.values(), *([] if questions else category_names.values())]
    }
    negatives = any(isinstance(image.get("neg_category_ids"), list) for image in images.values())
    for number, image_masks in by_number.items():
        entry = images[number]
        if number in questions:
            image_masks.searched = {normalize_text(questions[number])} - image_masks.not_searched
        elif negatives:
            absent, partial = (
                {normalize_text(category_names[other]) for other in _numbers(entry, key) if other in category_names}
                for key in ("neg_category_ids", "not_exhaustive_category_ids")
            )
            image_masks.searched = (
                (absent | {normalize_text(phrase) for phrase in image_masks.phrases})
                - partial
                - image_masks.not_searched
            )
            image_masks.annotated = bool(image_masks.phrases or absent)
        else:
            image_masks.annotated = bool(image_masks.phrases) or unannotated_negative
            image_masks.searched = phrases - image_masks.not_searched if image_masks.annotated else set()
        image_masks.not_searched = phrases - image_masks.searched
    return [*by_number.values()]


def _drop_upload_prefixes(images: Sequence[ImageMasks]) -> None:
    """Remove Label Studio's prefixes from the names if all images have one and not all are digits, as of dates."""
    paths = [PurePosixPath((image.image or "").replace("\\", "/")) for image in images]
    prefixes = [LABEL_STUDIO.match(path.name) for path in paths]
    if all(prefixes) and any(prefix and not prefix[0][:-1].isdecimal() for prefix in prefixes):
        for image, path in zip(images, paths, strict=True):
            image.image = str(path.with_name(LABEL_STUDIO.sub("", path.name)))


def _has_prompt(image: Mapping[str, Any]) -> bool:
    return isinstance(image.get("text_input"), str)


def _numbers(entry: Mapping[str, Any], key: str) -> list[int | str]:
    values = entry.get(key)
    return [number for number in values if isinstance(number, int | str)] if isinstance(values, list) else []


def _file_of(image: Mapping[str, Any]) -> str:
    return str(image.get("file_name") or image.get("coco_url") or "")


def _image_name(image: Mapping[str, Any], path: Path) -> str:
    extra = image.get("extra")  # of Roboflow, with the photo's original name
    original = extra.get("name") if isinstance(extra, dict) else None
    if isinstance(original, str) and original.strip():
        return original
    if isinstance(image.get("file_name"), str):
        return image_of(_path_of(image["file_name"]))
    if isinstance(image.get("coco_url"), str):  # of LVIS
        return PurePosixPath(image["coco_url"]).name
    raise InvalidFeatures(f"{path} images", expected="a file_name of each", got="none")


def _path_of(name: str) -> str:
    """Return the decoded path of a URL, as in files of Label Studio; other names unchanged."""
    if "://" in name or name.startswith("/data/"):
        parts = urlsplit(name)
        return unquote(parse_qs(parts.query).get("d", [parts.path])[0])
    return name


def _frames(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Convert a data set of videos to one of frames, in all of which the annotated phrases were searched for."""
    images, annotations = [], []
    for number, video in _by_id(content, "videos").items():
        names = video.get("file_names")
        for frame, name in enumerate(names if isinstance(names, list) else []):
            sides = {side: video.get(side) for side in ("height", "width")}
            images.append({"id": f"{number} {frame}", "file_name": name, **sides})
    for record in mask_records(content, path):
        masks = record.get("segmentations") if isinstance(record, dict) else None
        for frame, mask in enumerate(masks if isinstance(masks, list) else []):
            if mask is not None:
                frame_id = f"{record.get('video_id')} {frame}"
                annotations.append({**record, "image_id": frame_id, "segmentation": mask})
    return {"images": images, "annotations": annotations, "categories": content.get("categories")}


def _tracked(content: Mapping[str, Any], path: Path) -> ImageMasks:
    """Read the objects of Grounded SAM 2's tracking in a frame."""
    phrases: dict[int, str | None] = {}
    for number, record in content["labels"].items():
        location = f"{path} labels {number}"
        phrase = _phrase_of(record, {}, {}) if isinstance(record, dict) else None
        if phrase is None or not str(number).isdecimal():
            raise InvalidFeatures(location, expected="an id with a class_name", got=repr(record)[:80])
        phrases[int(number)] = phrase
    name = content["mask_name"]
    if not isinstance(name, str) or not name:
        raise InvalidFeatures(f"{path} mask_name", expected="the name of a file of ids", got=repr(name)[:80])
    return ImageMasks(None, phrases=[phrase for phrase in phrases.values() if phrase], ids=IdObjects(name, phrases))


def _panoptic(content: Any, path: Path, names: Mapping[int, str]) -> Iterator[ImageMasks]:
    """Yield the images of panoptic data sets of COCO, and of DEVA, which has no names of categories."""
    images, categories = _by_id(content, "images"), _by_id(content, "categories")
    for number, record in enumerate(mask_records(content, path)):
        location = f"{path} annotation {number}"
        file, segments = (
            record.get(key) if isinstance(record, dict) else None for key in ("file_name", "segments_info")
        )
        if not isinstance(file, str) or not isinstance(segments, list):
            raise InvalidFeatures(location, expected="a file_name and segments_info", got=repr(record)[:80])
        phrases: dict[int, str | None] = {0: VOID} if categories else {}  # 0 is unlabelled in COCO
        for segment in segments:
            kind = _id(segment, "category_id") if isinstance(segment, dict) else None
            phrase = categories.get(kind, {}).get("name", names.get(kind) if isinstance(kind, int) else None)
            if not isinstance(phrase, str) or not isinstance(segment.get("id"), int):
                hint = "give --names FILE (in Python names=), JSON from numbers of categories to names"
                raise InvalidFeatures(
                    location, expected="an id and a named category", got=repr(segment)[:80], hint=hint
                )
            phrases[segment["id"]] = phrase
        image = images.get(_id(record, "image_id"))
        name = file if image is None else _image_name(image, path)
        named_phrases = [phrase for phrase in phrases.values() if phrase]
        yield ImageMasks(name, phrases=named_phrases, ids=IdObjects(file, phrases), in_data_set=True)


def _by_id(content: Any, key: str) -> dict[Any, dict[str, Any]]:
    values = content.get(key) if isinstance(content, dict) else None
    entries = [entry for entry in values if isinstance(entry, dict)] if isinstance(values, list) else []
    return {number: entry for entry in entries if (number := _id(entry, "id")) is not None}


def _id(entry: Mapping[str, Any], key: str) -> int | str | None:
    number = entry.get(key)
    if isinstance(number, str) and number.isdecimal() and str(int(number[:20])) == number:  # a number as a text
        return int(number)
    return number if isinstance(number, int | str) else None


def views_of_images(names: Sequence[str]) -> dict[str, str]:
    """Return image path -> view for arbitrary paths: the stem if all stems differ.

    Otherwise folders are kept except for those that all paths share: ``/data/camA/000.jpg`` and
    ``/data/camB/000.jpg`` become ``camA/000`` and ``camB/000``.
    """
    paths = {name: without_image_suffix(name) for name in names}
    stems = {PurePosixPath(path).name for path in paths.values()}
    if len(stems) == len(set(paths.values())):
        return {name: PurePosixPath(path).name for name, path in paths.items()}
    parts = [PurePosixPath(path).parts[:-1] for path in paths.values()]
    shared = next(
        (k for k in range(min(map(len, parts))) if len({folders[k] for folders in parts}) > 1), min(map(len, parts))
    )
    return {name: "/".join(PurePosixPath(path).parts[shared:]) for name, path in paths.items()}


def tracked_view(ids: Path, document: Path, folder: Path, name: str) -> str:
    """Return the view of a frame of Grounded SAM 2's tracking: its name in the folder of both ids and document."""
    stem = composed(PurePosixPath(name.replace("\\", "/")).stem).removeprefix(TRACKED_PREFIX)
    common_folder = next(parent for parent in document.parents if ids.is_relative_to(parent))
    inside = common_folder.relative_to(folder).as_posix() if common_folder.is_relative_to(folder) else "."
    return stem if inside == "." else f"{inside}/{stem}"
