"""JSON documents of masks by phrase: which images they speak of, what is masked there, and what was looked for.

- COCO's data set, ``images``, ``annotations`` and ``categories``. An image without an annotation may show anything:
  nobody has come to it yet, or nothing is there, and programs export both alike (Label Studio, Roboflow, CVAT). Only
  two kinds of file say that a phrase is absent: SA-Co's, in which an image and its ``text_input`` are a question, and
  LVIS's, by ``neg_category_ids``; there ``not_exhaustive_category_ids`` are annotated in part.
- YouTube-VIS's and SA-Co's videos, ``videos`` with a ``segmentations`` entry for each frame.
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
VOID = None  # in place of a phrase: nobody decided what is there
# Roboflow's name of a photo: IMG_0000_jpg.rf.0123456789abcdef0123456789abcdef.jpg of IMG_0000.jpg.
ROBOFLOW = re.compile(r"_(?:jpe?g|png|bmp|webp|tiff?|heic|avif|mpo|dng)\.rf\.[0-9A-Za-z_-]+(?=\.[a-z]+$)", re.I)
# Label Studio's name of a photo: 1f2e3d4c-IMG_0000.jpg.
LABEL_STUDIO = re.compile(r"^[0-9a-f]{8}-(?=.)")

Masks = list[tuple[str | None, StoredMask]]


@dataclass
class ImageMasks:
    """What a document says of an image, or of a pair of an image and a phrase."""

    image: str | None  # its path, as the document has it; None: the document is named after it
    masks: Masks = field(default_factory=list)  # by phrase; VOID for what nobody decided
    phrases: list[str] = field(default_factory=list)  # of all records, those without a mask too
    decided: set[str] = field(default_factory=set)  # phrases, plain, that are masked there wherever they are
    undecided: set[str] = field(default_factory=set)  # that were not, or not wholly, looked for
    annotated: bool = True  # has a record, or the document says that nothing is there
    ids: "IdObjects | None" = None  # objects of a picture of ids
    listed: bool = False  # among the images of a data set
    file: str = ""  # of a data set, the name that it has there


@dataclass(frozen=True)
class IdObjects:
    """Objects by the ids of a picture or an array of numbers."""

    name: str  # of its file, whose suffix may be another
    phrases: dict[int, str | None]  # id -> phrase, or VOID


@dataclass
class MaskDocument:
    """The images of a document, and what a user should know of it."""

    path: Path
    images: list[ImageMasks]
    boxes: int = 0  # records that have a box and no mask
    polygons: list[PolygonMask] = field(default_factory=list)  # of all records

    def beyond(self) -> int:
        """Count the polygons that reach beyond their images.

        Raises:
            InvalidFeatures: they would not, of images of one size, were width and height exchanged.
        """
        by_size: dict[tuple[int, int], list[PolygonMask]] = {}
        for polygon in self.polygons:
            by_size.setdefault(polygon.size, []).append(polygon)
        count = 0
        for (height, width), polygons in by_size.items():
            beyond = sum(polygon.reaches_beyond((height, width)) for polygon in polygons)
            if beyond and not any(polygon.reaches_beyond((width, height)) for polygon in polygons):
                got = f"{beyond} of {len(polygons)} that fit {height} x {width} alone"
                hint = "width and height are exchanged: write those of the photos as they were annotated"
                expected = f"polygons within images of {width} x {height} pixels"
                raise InvalidFeatures(str(self.path), expected=expected, got=got, hint=hint)
            count += beyond
        return count

    def has_ids(self) -> bool:
        """Return whether it speaks of objects by ids, which lie in other files."""
        return any(image.ids is not None for image in self.images)


def read_mask_document(path: Path, names: Mapping[int, str], *, unannotated_negative: bool = False) -> MaskDocument:
    """Read a JSON document of masks by phrase.

    Args:
        names: phrases of categories by their numbers, where the document does not name them (DEVA's).
        unannotated_negative: images without an annotation show none of the document's phrases.

    Raises:
        InvalidFeatures: no such document, or a record without a phrase, of an unknown image, or with a broken mask.
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
    elif any(isinstance(one, dict) and "segments_info" in one for one in mask_records(content, path)):
        document.images = [*_panoptic(content, path, names)]
    elif isinstance(content, dict) and isinstance(content.get("images"), list):
        document.images = _data_set(content, document, unannotated_negative=unannotated_negative)
    else:
        image, size = _stated_image(content), stated_size(content)
        document.images = [found := ImageMasks(image)]
        for number, record in enumerate(mask_records(content, path)):
            _add_record(found, record, size, document, f"{path} mask {number}", {})
    return document


def _other_program(content: Any) -> tuple[str, str] | None:
    """What a document of another program is, and what to do with it; None where it may be one that is read."""
    first = next(iter(content if isinstance(content, list) else content.values()), None) if content else None
    first = first if isinstance(first, dict) else {}
    own = content if isinstance(content, dict) else {}
    if "_via_img_metadata" in own or {"filename", "regions"} <= first.keys():
        return "annotations of VGG Image Annotator, which have no size of their images", f"{AS_COCO} from it"
    if isinstance(content, list) and "data" in first and {"annotations", "completions"} & first.keys():
        return "tasks of Label Studio", f"{AS_COCO} from it"
    if "items" in own and "categories" in own:
        return "a data set of Datumaro", f"{AS_COCO}: datum convert -f coco_instances"
    if isinstance(content, list) and {"value", "label"} == first.keys():
        hint = "take Grounded SAM 2, or write each mask as PHRASE/VIEW.png"
        return "the names of Grounded SAM's mask.jpg, a picture in colours that has lost their ids", hint
    return None


def stated_size(content: Any) -> tuple[int, int] | None:
    """Height and width of an image that a document, or what it says of its image, states; None where none does."""
    if not isinstance(content, dict):
        return None
    slots = content["item"].get("slots") if isinstance(content.get("item"), dict) else None  # of Darwin
    first = slots[:1] if isinstance(slots, list) else []
    for place in (content, *(content.get(key) for key in ("image", "info", "size")), *first):
        for keys in SIZE_KEYS:
            height, width = (_side(place.get(key) if isinstance(place, dict) else None) for key in keys)
            if height is not None and width is not None:
                return height, width
    return None


def _side(stated: Any) -> int | None:
    """A whole number of pixels, if only as a text."""
    stated = int(stated) if isinstance(stated, str) and stated.isdecimal() and len(stated) < 10 else stated
    is_whole = isinstance(stated, int | float) and not isinstance(stated, bool) and stated % 1 == 0
    return int(stated) if is_whole else None


def image_of(name: str) -> str:
    """The photo's name of a name that Roboflow gave it; others as they are."""
    return ROBOFLOW.sub("", name)


def _stated_image(content: Any) -> str | None:
    if not isinstance(content, dict):
        return None
    image, info = content.get("image"), content.get("info")
    stated = [content.get(key) for key in IMAGE_KEYS]
    stated += [image, *(image.get(key) for key in ("file_name", "path"))] if isinstance(image, dict) else [image]
    stated += [one.get("name") for one in (info, content.get("item")) if isinstance(one, dict)]
    return next((name for name in stated if isinstance(name, str) and name.strip()), None)


def _phrase_of(record: Mapping[str, Any], category: Mapping[str, Any], image: Mapping[str, Any]) -> str | None:
    said = (*map(record.get, PHRASE_KEYS), image.get("text_input"), category.get("name"))
    return next((phrase for phrase in said if isinstance(phrase, str)), None)


def _add_record(
    found: ImageMasks,
    record: Any,
    size: tuple[int, int] | None,
    document: MaskDocument,
    where: str,
    category: Mapping[str, Any],
    image: Mapping[str, Any] | None = None,
) -> None:
    """Add a record of a mask to its image; where it has a box alone, what is inside is undecided."""
    if not isinstance(record, dict):
        raise InvalidFeatures(where, expected="a mask with a phrase", got=type(record).__name__)
    # Of LabelMe, whose two points are corners.
    is_box = record.get("shape_type") not in (None, "polygon", "mask", "circle")
    mask = None if is_box else read_mask(record, size, where)
    phrase = _phrase_of(record, category, image or {})
    if phrase is None:
        expected, hint = f"a phrase ({', '.join(PHRASE_KEYS[:5])} or a category)", "'splatlift pack masks' needs none"
        if "category_id" in record:
            hint = "put results of COCO as 'annotations' into a JSON with its 'images' and 'categories'"
            raise InvalidFeatures(where, expected=expected, got="a category_id without categories", hint=hint)
        raise InvalidFeatures(where, expected=expected, got="none", hint=hint)
    if phrase == ISAT_BACKGROUND:
        return
    found.phrases.append(phrase)
    if mask is not None:
        document.polygons += [mask] if isinstance(mask, PolygonMask) else []
        if not mask.is_empty():
            found.masks.append((phrase, mask))
        return
    document.boxes += 1
    box = _box(record.get("points") if is_box else record.get("bbox"), corners=is_box)
    if box is None or size is None:
        found.undecided.add(normalize_text(phrase))
    else:
        check_size(size, where)
        found.masks.append((VOID, PolygonMask(size, (box,))))


def _box(sides: Any, *, corners: bool) -> Any:
    """[4, 2] f64, the corners of COCO's box (x, y, width, height) or of two of its corners; None of what is none."""
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
    """The images of COCO's data set."""
    path = document.path
    images, categories = _by_id(content, "images"), _by_id(content, "categories")
    found = {
        number: ImageMasks(_image_name(image, path), listed=True, file=_file_of(image))
        for number, image in images.items()
    }
    _drop_upload_prefixes([*found.values()])
    for number, record in enumerate(mask_records(content, path)):
        where = f"{path} mask {number}"
        if not isinstance(record, dict):
            raise InvalidFeatures(where, expected="a mask with a phrase", got=type(record).__name__)
        image = _id(record, "image_id")
        if image not in found:
            raise InvalidFeatures(where, expected="an image_id of the file", got=repr(image)[:80])
        size, category = stated_size(images[image]), categories.get(_id(record, "category_id"), {})
        _add_record(found[image], record, size, document, where, category, images[image])
    named = {other: one["name"] for other, one in categories.items() if isinstance(one.get("name"), str)}
    questions = {number: image["text_input"] for number, image in images.items() if _asks(image)}
    masked = [phrase for one in found.values() for phrase in one.phrases]
    phrases = {
        normalize_text(phrase) for phrase in [*masked, *questions.values(), *([] if questions else named.values())]
    }
    negatives = any(isinstance(image.get("neg_category_ids"), list) for image in images.values())
    for number, one in found.items():
        told = images[number]
        if number in questions:
            one.decided = {normalize_text(questions[number])} - one.undecided
        elif negatives:
            absent, partial = (
                {normalize_text(named[other]) for other in _numbers(told, key) if other in named}
                for key in ("neg_category_ids", "not_exhaustive_category_ids")
            )
            one.decided = (absent | {normalize_text(phrase) for phrase in one.phrases}) - partial - one.undecided
            one.annotated = bool(one.phrases or absent)
        else:
            one.annotated = bool(one.phrases) or unannotated_negative
            one.decided = phrases - one.undecided if one.annotated else set()
        one.undecided = phrases - one.decided
    return [*found.values()]


def _drop_upload_prefixes(images: Sequence[ImageMasks]) -> None:
    """Take Label Studio's prefixes off the names, if all images have one and letters tell them from dates."""
    paths = [PurePosixPath((image.image or "").replace("\\", "/")) for image in images]
    prefixes = [LABEL_STUDIO.match(path.name) for path in paths]
    if all(prefixes) and any(prefix and not prefix[0][:-1].isdecimal() for prefix in prefixes):
        for image, path in zip(images, paths, strict=True):
            image.image = str(path.with_name(LABEL_STUDIO.sub("", path.name)))


def _asks(image: Mapping[str, Any]) -> bool:
    return isinstance(image.get("text_input"), str)


def _numbers(entry: Mapping[str, Any], key: str) -> list[int | str]:
    listed = entry.get(key)
    return [number for number in listed if isinstance(number, int | str)] if isinstance(listed, list) else []


def _file_of(image: Mapping[str, Any]) -> str:
    return str(image.get("file_name") or image.get("coco_url") or "")


def _image_name(image: Mapping[str, Any], path: Path) -> str:
    extra = image.get("extra")  # where Roboflow keeps the name that the photo had
    original = extra.get("name") if isinstance(extra, dict) else None
    if isinstance(original, str) and original.strip():
        return original
    if isinstance(image.get("file_name"), str):
        return image_of(_path_of(image["file_name"]))
    if isinstance(image.get("coco_url"), str):  # LVIS's
        return PurePosixPath(image["coco_url"]).name
    raise InvalidFeatures(f"{path} images", expected="a file_name of each", got="none")


def _path_of(name: str) -> str:
    """The path of a URL, as Label Studio has some, decoded; another name as it is."""
    if "://" in name or name.startswith("/data/"):
        parts = urlsplit(name)
        return unquote(parse_qs(parts.query).get("d", [parts.path])[0])
    return name


def _frames(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """A data set of videos as one of their frames, in which all that is annotated was looked for."""
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
    """The objects of Grounded SAM 2's tracking in a frame."""
    phrases: dict[int, str | None] = {}
    for number, record in content["labels"].items():
        where = f"{path} labels {number}"
        phrase = _phrase_of(record, {}, {}) if isinstance(record, dict) else None
        if phrase is None or not str(number).isdecimal():
            raise InvalidFeatures(where, expected="an id with a class_name", got=repr(record)[:80])
        phrases[int(number)] = phrase
    name = content["mask_name"]
    if not isinstance(name, str) or not name:
        raise InvalidFeatures(f"{path} mask_name", expected="the name of a file of ids", got=repr(name)[:80])
    return ImageMasks(None, phrases=[phrase for phrase in phrases.values() if phrase], ids=IdObjects(name, phrases))


def _panoptic(content: Any, path: Path, names: Mapping[int, str]) -> Iterator[ImageMasks]:
    """The images of COCO's panoptic data sets, and of DEVA's, which does not name its categories."""
    images, categories = _by_id(content, "images"), _by_id(content, "categories")
    for number, record in enumerate(mask_records(content, path)):
        where = f"{path} annotation {number}"
        file, segments = (
            record.get(key) if isinstance(record, dict) else None for key in ("file_name", "segments_info")
        )
        if not isinstance(file, str) or not isinstance(segments, list):
            raise InvalidFeatures(where, expected="a file_name and segments_info", got=repr(record)[:80])
        phrases: dict[int, str | None] = {0: VOID} if categories else {}  # COCO's 0 is what nobody decided
        for segment in segments:
            kind = _id(segment, "category_id") if isinstance(segment, dict) else None
            phrase = categories.get(kind, {}).get("name", names.get(kind) if isinstance(kind, int) else None)
            if not isinstance(phrase, str) or not isinstance(segment.get("id"), int):
                hint = "name the categories with --names FILE (in Python names=), JSON from their numbers to names"
                raise InvalidFeatures(where, expected="an id and a named category", got=repr(segment)[:80], hint=hint)
            phrases[segment["id"]] = phrase
        image = images.get(_id(record, "image_id"))
        name = file if image is None else _image_name(image, path)
        said = [phrase for phrase in phrases.values() if phrase]
        yield ImageMasks(name, phrases=said, ids=IdObjects(file, phrases), listed=True)


def _by_id(content: Any, key: str) -> dict[Any, dict[str, Any]]:
    listed = content.get(key) if isinstance(content, dict) else None
    entries = [entry for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    return {number: entry for entry in entries if (number := _id(entry, "id")) is not None}


def _id(entry: Mapping[str, Any], key: str) -> int | str | None:
    number = entry.get(key)
    if isinstance(number, str) and number.isdecimal() and str(int(number[:20])) == number:  # a number as a text
        return int(number)
    return number if isinstance(number, int | str) else None


def views_of_images(names: Sequence[str]) -> dict[str, str]:
    """Image path -> view, of documents that name their images by any path: the stem, where all are different.

    Else folders stay, but for those that all paths share: ``/data/camA/000.jpg`` and ``/data/camB/000.jpg`` are
    ``camA/000`` and ``camB/000``.
    """
    paths = {name: without_image_suffix(name) for name in names}
    stems = {PurePosixPath(path).name for path in paths.values()}
    if len(stems) == len(set(paths.values())):
        return {name: PurePosixPath(path).name for name, path in paths.items()}
    parts = [PurePosixPath(path).parts[:-1] for path in paths.values()]
    shared = next(
        (k for k in range(min(map(len, parts))) if len({one[k] for one in parts}) > 1), min(map(len, parts))
    )
    return {name: "/".join(PurePosixPath(path).parts[shared:]) for name, path in paths.items()}


def tracked_view(ids: Path, document: Path, folder: Path, name: str) -> str:
    """The view of a frame of Grounded SAM 2's tracking: its name, in the folder that holds both ids and document."""
    stem = composed(PurePosixPath(name.replace("\\", "/")).stem).removeprefix(TRACKED_PREFIX)
    both = next(one for one in document.parents if ids.is_relative_to(one))
    inside = both.relative_to(folder).as_posix() if both.is_relative_to(folder) else "."
    return stem if inside == "." else f"{inside}/{stem}"
