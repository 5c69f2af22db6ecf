"""JSON documents of masks by phrase: their images, the masks, and the phrases that were searched for.

- COCO's data set, ``images``, ``annotations`` and ``categories``. An image without an annotation is either not
  annotated yet or empty, and programs export both in the same way (Label Studio, Roboflow, CVAT).
- Records of one image, a list or under ``annotations``, as Grounded SAM 2 writes them; the document may name the
  image (``image_path``).
- Objects by the ids of a picture of numbers: Grounded SAM 2's tracking (``mask_name`` and ``labels``, with the ids in
  ``mask_data``).
"""

import posixpath
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from liftcore.errors import InvalidFeatures, reading
from liftcore.features.mask_files import (
    AS_COCO,
    MAX_COORDINATE,
    StoredMask,
    check_size,
    fill_polygons,
    mask_records,
    read_mask,
    read_mask_json,
    stored_mask,
)
from liftcore.scene.views import composed, without_image_suffix
from liftcore.text.table import normalize_text

PHRASE_KEYS = ("phrase", "class_name", "label", "text", "category")  # of a record
SIZE_KEYS = (("img_height", "img_width"), ("height", "width"))
TRACKED_PREFIX = "mask_"  # of Grounded SAM 2, before the name of the image
VOID = None  # in place of a phrase: pixels that are unlabelled
OVERHANG = 0.02  # of the image's sides, by which polygons drawn by hand may extend beyond it
# Roboflow's name of a photo: IMG_0000_jpg.rf.0123456789abcdef0123456789abcdef.jpg of IMG_0000.jpg.
ROBOFLOW = re.compile(r"_(?:jpe?g|png|bmp|webp|tiff?|heic|avif|mpo|dng)\.rf\.[0-9A-Za-z_-]+(?=\.[a-z]+$)", re.I)
# Label Studio's name of a photo: 1f2e3d4c-IMG_0000.jpg.
LABEL_STUDIO = re.compile(r"^[0-9a-f]{8}-(?=.)")


@dataclass
class ImageMasks:
    """Masks of an image in a document."""

    image: str | None  # its path in the document; None: the image has the name of the document
    masks: list[tuple[str | None, StoredMask]] = field(default_factory=list)  # by phrase; VOID for unlabelled pixels
    phrases: list[str] = field(default_factory=list)  # of all records, also those without a mask
    annotated: bool = True  # has a record, or is listed as empty
    file: str = ""  # its file name in a data set
    ids: str = ""  # the file of a picture of ids, possibly with another suffix
    id_phrases: dict[int, str | None] = field(default_factory=dict)


@dataclass
class MaskDocument:
    """The images of a document, with counts for warnings."""

    path: Path
    images: list[ImageMasks]
    phrases: frozenset[str] = frozenset()  # normalized, that the annotated images of a data set were searched for
    boxes: int = 0  # records that have a box and no mask
    beyond: int = 0  # polygons that extend beyond their image


def read_mask_document(path: Path, *, unannotated_negative: bool) -> MaskDocument:
    """Read a JSON document of masks by phrase."""
    document = MaskDocument(path, [])
    with reading(path, InvalidFeatures, "COCO's JSON, or records with masks and phrases", AS_COCO):
        content = read_mask_json(path)
        fields = content if isinstance(content, dict) else {}
        if "mask_name" in fields and isinstance(fields.get("labels"), dict):
            document.images = [_tracked(fields)]
        elif isinstance(fields.get("images"), list):
            _add_data_set(document, fields, unannotated_negative=unannotated_negative)
        else:
            document.images = [image := ImageMasks(_text_of(fields, "image_path", "file_name"))]
            size = declared_size(fields)
            for number, record in enumerate(mask_records(content)):
                with reading(f"{path} mask {number}", InvalidFeatures, "a mask with a phrase", AS_COCO):
                    _add_record(image, record, size, document, {})
    return document


def declared_size(content: Any) -> tuple[int, int] | None:
    """Return height and width of an image from its entry in a document; None if they are missing."""
    for keys in SIZE_KEYS:
        sides = [content[key] for key in keys if key in content] if isinstance(content, dict) else []
        if len(sides) == 2 and all(isinstance(side, int | float) and side % 1 == 0 for side in sides):
            return int(sides[0]), int(sides[1])
    return None


def _text_of(record: Any, *keys: str) -> str | None:
    texts = map(record.get, keys) if isinstance(record, dict) else ()
    return next((text for text in texts if isinstance(text, str) and text.strip()), None)


def _add_record(
    image: ImageMasks,
    record: Any,
    size: tuple[int, int] | None,
    document: MaskDocument,
    categories: Mapping[Any, str],
) -> None:
    """Add a record of a mask to its image. The pixels of a box without a mask become unlabelled."""
    if not isinstance(record, dict):
        raise ValueError(f"a mask with a phrase, got {type(record).__name__}; {AS_COCO}")
    phrase = _text_of(record, *PHRASE_KEYS) or categories.get(record.get("category_id"))
    if phrase is None:
        hint = f"{AS_COCO}, or take 'splatlift pack masks', which needs no phrases"
        if "category_id" in record:
            hint = "write results of COCO as 'annotations' of a JSON with its 'images' and 'categories'"
        raise ValueError(f"a phrase ({', '.join(PHRASE_KEYS)}, or a category), got none; {hint}")
    image.phrases.append(phrase)
    segmentation = record.get("segmentation")
    mask = read_mask(segmentation, size)
    if mask is None:
        document.boxes += 1
        image.masks.append((VOID, _box_mask(record.get("bbox"), size)))
    elif not mask.is_empty():
        image.masks.append((phrase, mask))
    if size is not None and isinstance(segmentation, list):
        height, width = size
        corners = np.concatenate([np.ravel(part) for part in segmentation]) if segmentation else np.zeros(0)
        limit = np.array([width, height]) * (1 + OVERHANG) + 1
        document.beyond += bool((corners[: len(corners) // 2 * 2].reshape(-1, 2) > limit).any())


def _box_mask(box: Any, size: tuple[int, int] | None) -> StoredMask:
    """Return the pixels of a box x, y, width, height of an image of a known size."""
    numbers = np.array(box, np.float64).reshape(-1) if isinstance(box, list) else np.zeros(0)
    if size is None or len(numbers) != 4 or not (np.abs(numbers) <= MAX_COORDINATE).all():
        raise ValueError(f"a mask, or a bbox [x, y, width, height] within an image of a known size, got {box!r}")
    x, y, width, height = numbers
    corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
    return stored_mask(fill_polygons(check_size(size), [corners]))


def _add_data_set(document: MaskDocument, content: Mapping[str, Any], *, unannotated_negative: bool) -> None:
    """Add the images of a COCO data set."""
    entries = {entry["id"]: entry for entry in content["images"]}
    category_names = [(entry["id"], _text_of(entry, "name")) for entry in content.get("categories") or ()]
    categories = {number: name for number, name in category_names if name is not None}
    names = {number: _text_of(entry, "file_name") or "" for number, entry in entries.items()}
    if "" in names.values():
        raise ValueError("a file_name of each image, got an image without one")
    images = {number: ImageMasks(ROBOFLOW.sub("", name), file=name) for number, name in names.items()}
    _drop_upload_prefixes([*images.values()])
    for number, record in enumerate(mask_records(content)):
        with reading(f"{document.path} mask {number}", InvalidFeatures, "a mask with a phrase", AS_COCO):
            image = record.get("image_id") if isinstance(record, dict) else record
            if image not in images:
                raise ValueError(f"an image_id of the file, got {repr(image)[:80]}")
            _add_record(images[image], record, declared_size(entries[image]), document, categories)
    masked = [phrase for image in images.values() for phrase in image.phrases]
    document.phrases = frozenset(normalize_text(phrase) for phrase in [*masked, *categories.values()])
    document.images = [*images.values()]
    for image in document.images:
        image.annotated = bool(image.phrases) or unannotated_negative


def _drop_upload_prefixes(images: Sequence[ImageMasks]) -> None:
    """Remove Label Studio's prefixes from the names if all images have one and not all are digits, as of dates."""
    paths = [PurePosixPath((image.image or "").replace("\\", "/")) for image in images]
    prefixes = [LABEL_STUDIO.match(path.name) for path in paths]
    if all(prefixes) and any(prefix and not prefix[0][:-1].isdecimal() for prefix in prefixes):
        for image, path in zip(images, paths, strict=True):
            image.image = str(path.with_name(LABEL_STUDIO.sub("", path.name)))


def _tracked(content: Mapping[str, Any]) -> ImageMasks:
    """Read the objects of Grounded SAM 2's tracking in a frame."""
    phrases: dict[int, str | None] = {}
    for number, record in content["labels"].items():
        phrases[int(number)] = phrase = _text_of(record, *PHRASE_KEYS)
        if phrase is None:
            raise ValueError(f"labels of an id and a class_name, got {number}: {repr(record)[:80]}")
    return ImageMasks(
        None, phrases=[*filter(None, phrases.values())], ids=str(content["mask_name"]), id_phrases=phrases
    )


def views_of_images(names: Sequence[str]) -> dict[str, str]:
    """Return image path -> view for arbitrary paths: the stem if all stems differ.

    Otherwise folders are kept except for those that all paths share: ``/data/camA/000.jpg`` and
    ``/data/camB/000.jpg`` become ``camA/000`` and ``camB/000``.
    """
    paths = {name: without_image_suffix(name) for name in names}
    stems = {PurePosixPath(path).name for path in paths.values()}
    if len(stems) == len(set(paths.values())):
        return {name: PurePosixPath(path).name for name, path in paths.items()}
    shared = posixpath.commonpath([posixpath.dirname(path) for path in paths.values()])
    return {name: PurePosixPath(path).relative_to(shared).as_posix() for name, path in paths.items()}


def tracked_view(ids: Path, document: Path, folder: Path, name: str) -> str:
    """Return the view of a frame of Grounded SAM 2's tracking: its name in the folder of both ids and document."""
    stem = composed(PurePosixPath(name.replace("\\", "/")).stem).removeprefix(TRACKED_PREFIX)
    common_folder = next(parent for parent in document.parents if ids.is_relative_to(parent))
    inside = common_folder.relative_to(folder).as_posix() if common_folder.is_relative_to(folder) else "."
    return stem if inside == "." else f"{inside}/{stem}"
