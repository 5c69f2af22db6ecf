"""Masks by text prompt, as of SAM 3 and Grounding DINO: regions whose vectors represent phrases.

Phrase k of n has the k-th unit vector of n + 1 channels. Pixels outside of all masks have the last one, as they were
searched and show no phrase. So a lifted feature is the fraction of a splat's weight within the masks of each phrase,
and the cosine to a phrase is near 1 if nearly all of it is. The vectors of the phrases are stored in the pack as a
table, so a lift of it can be queried by these words without an encoder.

A folder contains, with sub-folders if names of views have some (``camA/000``), one of:

* binary pictures, ``PHRASE/VIEW.png``; ``_`` stands for a space. They are PNGs, or arrays [h, w] in ``.npy`` or
  ``.npz``;
* JSON: data sets of COCO, or Grounded SAM 2's records and tracking (`liftcore.features.mask_json`);
* label pictures ``VIEW.png`` with the names of their values: in a JSON, or in the picture's text ``legend``, as
  ``splatlift segment --map`` writes it.

Masks of one phrase in a view are merged. A view counts if it has a file or a record, also of an empty mask. These
pixels have no label: those with the value ``unlabelled``, those within a box without a mask, and those outside of all
masks in a view that was not searched for every phrase.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from liftcore.errors import InvalidFeatures, reading
from liftcore.features.folders import ViewFolder, files_below
from liftcore.features.mask_files import AS_COCO, StoredMask, binary_mask, binary_picture, label_png
from liftcore.features.mask_json import (
    VOID,
    ImageMasks,
    MaskDocument,
    read_mask_document,
    tracked_view,
    views_of_images,
)
from liftcore.io.files import visible_files
from liftcore.io.npy import ARRAYS, NUMBERS, open_array
from liftcore.runtime.one_line import join_names
from liftcore.scene.views import composed, require_name, without_image_suffix
from liftcore.text.table import TableEncoder, normalize_text
from liftcore.values.views import NO_LABEL, Regions, label_levels

MAX_PHRASES = 4_096
MAX_LISTED = 6  # phrases in a warning
LEGEND = "legend"  # the text of a label picture that names its values
LAYOUTS = "PHRASE/VIEW.png, COCO's JSON, or label pictures VIEW.png with --names"
NAMES = 'JSON from values to names, {"1": "red mug"}'
PICTURE = ".png"
BOXES = (
    "{count} annotations of {files} have at most a box and no mask: pixels in the boxes have no label; create masks "
    "from the boxes, for example with SAM"
)
BEYOND = (
    "{count} polygons of {files} extend beyond their images and are clipped: width and height must be those of the "
    "annotated photos, and may be swapped"
)
MASK_DATA = "mask_data"  # folder of Grounded SAM 2's tracking, next to json_data

Unannotated = Literal["skip", "negative"]
Images = Sequence[tuple[MaskDocument, ImageMasks]]
Masks = Iterable[tuple[str | None, np.ndarray]]  # of a file: [h, w] bool by phrase, or by VOID for unlabelled pixels


@dataclass
class _View:
    """The masks of a view."""

    file: Path  # the first that names it
    sources: list[Callable[[], Masks]] = field(default_factory=list)  # of a file, or part of one
    phrases: set[str] = field(default_factory=set)  # normalized, with a pixel
    searched: set[str] = field(default_factory=set)  # normalized, that some data set searched for
    not_searched: set[str] = field(default_factory=set)  # normalized, that some data set did not search for
    has_void: bool = False

    def was_searched(self, phrases: Iterable[str]) -> bool:
        """Return True if the view was searched for all of these phrases."""
        return not (self.not_searched - self.searched).intersection(phrases)


@dataclass
class _MaskIndex:
    """Sources of the masks of each view, by phrase."""

    phrases: dict[str, str] = field(default_factory=dict)  # normalized -> as first written
    views: dict[str, _View] = field(default_factory=dict)

    def view(self, name: str, path: Path) -> _View:
        """Return the view of this name, added if it is new."""
        require_name(name, f"the view of {str(path)!a}", InvalidFeatures)
        return self.views.setdefault(name, _View(path))

    def name(self, view: str, phrase: str) -> str:
        """Add a phrase of a view, and return its normalized form."""
        if not (key := normalize_text(phrase)):
            raise ValueError(f"a phrase for each mask, got an empty phrase in the view {view!r}")
        require_name(phrase, f"a phrase of the view {view!r}", InvalidFeatures)
        self.phrases.setdefault(key, " ".join(composed(phrase).replace("_", " ").split()))
        return key

    def add(self, name: str, path: Path, phrases: Iterable[str | None], source: Callable[[], Masks]) -> None:
        """Add a file with pixels of these phrases to a view."""
        view, phrases = self.view(name, path), [*phrases]
        if phrases:
            view.sources.append(source)
        view.has_void = view.has_void or VOID in phrases
        view.phrases.update(self.name(name, phrase) for phrase in phrases if phrase is not None)


@dataclass(frozen=True)
class Prompts:
    """Views of a folder of masks, and the table of their phrases."""

    views: ViewFolder[Regions]
    table: TableEncoder
    warnings: tuple[str, ...] = ()  # of omitted images and phrases, and of unlabelled pixels


def prompt_views(
    folder: Path, names: Path | None = None, *, unlabelled: int | None = None, unannotated: Unannotated = "skip"
) -> Prompts:
    """Open the regions of a folder of masks by phrase (see the module). Each view is read at every access.

    Args:
        folder: of the masks. names: of label pictures, JSON from values to names.
        unlabelled: value of unlabelled pixels in pictures (255).
        unannotated: images of a data set without an annotation: ``skip`` them, or ``negative``, they show no phrase.
    """
    files = [path for path in files_below(folder) if names is None or not path.samefile(names)]
    documents = [path for path in files if path.suffix.lower() == ".json"]
    pictures = [path for path in files if path.suffix.lower() == PICTURE]
    arrays = [path for path in files if path.suffix.lower() in ARRAYS]
    index, warnings = _MaskIndex(), list[str]()
    if documents:
        if unlabelled is not None:
            got = f"{unlabelled} for {documents[0].name}"
            raise InvalidFeatures("unlabelled", expected="None without pictures", got=got)
        warnings += _add_documents(index, documents, folder, [*arrays, *pictures], negative=unannotated == "negative")
    elif pictures and (names is not None or LEGEND in label_texts(pictures[0])):
        value_names = None
        if names is not None:
            with reading(names, InvalidFeatures, NAMES, "0 is outside of all masks, and needs no name"):
                value_names = _names_of_json(names.read_text(encoding="utf-8-sig"))
        for path in pictures:
            with reading(path, InvalidFeatures, "a label picture"):
                _add_labels(index, path, _view_of(path, folder), value_names, unlabelled)
    elif pictures or any(len(path.relative_to(folder).parts) > 1 for path in arrays):
        for path in pictures or arrays:
            with reading(path, InvalidFeatures, "a mask [h, w]"):
                _add_binary(index, path, path.relative_to(folder), unlabelled)
    else:
        suffixes = ", ".join(sorted({path.suffix for path in files}))
        hint = f"write masks as PNG, or {AS_COCO}; of arrays of tracking give the folder that also contains json_data"
        raise ValueError(f"one of {LAYOUTS}, got {len(files)} other files ({suffixes[:80]}); {hint}")
    return _prompts(index, files, warnings)


def _prompts(index: _MaskIndex, files: Sequence[Path], warnings: list[str]) -> Prompts:
    """Number the phrases that have masks, and leave out the views without labels."""
    order = sorted({phrase for view in index.views.values() for phrase in view.phrases})
    if not 1 <= len(order) <= MAX_PHRASES:
        got = f"{len(order)} of {len(index.phrases)} phrases"
        raise ValueError(f"1 to {MAX_PHRASES} phrases with masks, got {got}; {'; '.join(warnings)}")
    labelled_views = {
        name: view for name, view in index.views.items() if view.phrases or view.has_void or view.was_searched(order)
    }
    if partly := sum(not view.was_searched(order) for view in labelled_views.values()):
        warnings.append(
            f"{partly} of {len(labelled_views)} views were not searched for every phrase, according to their files: "
            "pixels outside of all masks have no label there"
        )
    rows = {phrase: row for row, phrase in enumerate(order)}
    vectors = np.eye(len(order) + 1, dtype=np.float16)

    def read_view(name: str) -> Regions:
        return _regions(name, labelled_views[name], rows, vectors)

    views = ViewFolder({name: view.file for name, view in labelled_views.items()}, read_view, files)
    table = TableEncoder("phrases", [index.phrases[phrase] for phrase in order], vectors[:-1])
    if empty := [text for phrase, text in sorted(index.phrases.items()) if phrase not in rows]:
        warnings.append(f"no view has a mask of {join_names(empty, MAX_LISTED)}: phrases omitted")
    return Prompts(views, table, tuple(warnings))


def label_texts(path: Path) -> dict[str, str]:
    """Read the texts of a label picture; empty for other files."""
    try:
        return label_png(path)[1]
    except (ValueError, OSError):
        return {}


def _regions(name: str, view: _View, rows: Mapping[str, int], vectors: np.ndarray) -> Regions:
    masks: dict[str, np.ndarray] = {}
    void: np.ndarray | None = None
    for phrase, mask in (pair for source in view.sources for pair in source()):
        size = next(iter(masks.values()), mask if void is None else void).shape
        if mask.shape != size:
            got = f"{size[0]} x {size[1]} and {mask.shape[0]} x {mask.shape[1]}"
            raise ValueError(f"masks of one size, got {got}; write the masks of one photo")
        if phrase is None:
            void = mask if void is None else void | mask
        elif (key := normalize_text(phrase)) in view.phrases:
            masks[key] = masks[key] | mask if key in masks else mask
    if masks:
        labels = label_levels(list(masks.values()))
    else:
        labels = np.full((1, 1, 1) if void is None else (1, *void.shape), NO_LABEL, np.int32)
    if view.was_searched(rows):
        rest = (labels == NO_LABEL).all(axis=0)
        labels[0][rest if void is None else rest & ~void] = len(masks)
    return Regions(labels, vectors[[*(rows[phrase] for phrase in masks), len(rows)]], context=f"view {name!r}")


def _view_of(path: Path, folder: Path) -> str:
    return without_image_suffix(path.relative_to(folder).with_suffix("").as_posix())


def _binary_masks(path: Path, phrase: str, unlabelled: int | None) -> Masks:
    """Read the mask of a picture or an array, and its unlabelled pixels."""
    if path.suffix.lower() == PICTURE:
        inside, void = binary_picture(path, unlabelled)
    else:
        inside, void = binary_mask(_plane(open_array(path, kinds=NUMBERS + "b")), unlabelled)
    return [(phrase, inside), (VOID, void)]


def _id_masks(path: Path, phrases: Mapping[int, str | None]) -> Masks:
    """Read the masks of the values of a picture or an array; other values show none of the phrases."""
    values = _ids(path)
    for phrase in dict.fromkeys(phrases.values()):
        yield phrase, np.isin(values, [value for value, name in phrases.items() if name == phrase])


def _ids(path: Path) -> np.ndarray:
    """Read a picture or an array of ids, [h, w] integers."""
    if path.suffix.lower() == PICTURE:
        return label_png(path)[0]
    return _plane(open_array(path, kinds=NUMBERS)).astype(np.int64)


def _plane(values: np.ndarray) -> np.ndarray:
    """Return an array without axes of length 1, [h, w]."""
    plane = values if values.ndim == 2 else np.squeeze(values)
    if plane.ndim != 2:
        raise ValueError(f"a mask or ids [h, w], got {values.dtype} {list(values.shape)}")
    return plane


def _add_binary(index: _MaskIndex, path: Path, inner: Path, unlabelled: int | None) -> None:
    phrase, *inside = PurePosixPath(inner.with_suffix("").as_posix()).parts
    if not inside:
        raise ValueError(f"{LAYOUTS}, got a picture outside of folders of phrases, without names")
    name = without_image_suffix("/".join(inside))
    index.view(name, path)
    index.name(name, phrase)
    (_, mask), (_, void) = _binary_masks(path, phrase, unlabelled)
    present = [label for label, pixels in ((phrase, mask), (VOID, void)) if pixels.any()]
    index.add(name, path, present, partial(_binary_masks, path, phrase, unlabelled))


def _add_labels(
    index: _MaskIndex, path: Path, name: str, names: Mapping[int, str] | None, unlabelled: int | None
) -> None:
    values, texts = label_png(path)
    phrases: dict[int, str | None] = dict(_names_of_json(texts.get(LEGEND, "")) if names is None else names)
    if unlabelled is not None:
        phrases[unlabelled] = VOID
    named_values = ", ".join(str(value) for value in [*phrases][:6] if value)
    for value in np.unique(values[(values != 0) | (unlabelled == 0)]).tolist():
        if value not in phrases:
            hint = f"if it marks unlabelled pixels, give --unlabelled {value} (in Python unlabelled={value})"
            raise ValueError(f"a name for each value except 0 ({named_values}), got the value {value}; {hint}")
    _add_ids(index, name, path, values, phrases)


def _add_ids(index: _MaskIndex, name: str, path: Path, values: np.ndarray, phrases: Mapping[int, str | None]) -> None:
    present = {value: phrases[value] for value in np.unique(values).tolist() if value in phrases}
    present = {value: phrase for value, phrase in present.items() if value or phrase is None}
    index.add(name, path, present.values(), partial(_id_masks, path, present))


def _names_of_json(text: str) -> dict[int, str]:
    try:
        names = {int(value): name for value, name in json.loads(text).items()}
    except (ValueError, AttributeError):
        names = {}
    if not names or not all(isinstance(name, str) and name.strip() for name in names.values()):
        raise ValueError(f"{NAMES}, got {text[:60]!r}")
    return names


def _add_documents(
    index: _MaskIndex, paths: Sequence[Path], folder: Path, other_files: Sequence[Path], *, negative: bool
) -> list[str]:
    """Add the masks of all documents, and return warnings."""
    documents = [read_mask_document(path, unannotated_negative=negative) for path in paths]
    images = [(document, image) for document in documents for image in document.images]
    views, id_files = _views_of(images, folder), _id_files(images, folder, other_files)
    names_images = all(image.image or image.ids for _, image in images)
    if not names_images and (pictures := [path.name for path in other_files if path.suffix.lower() == PICTURE]):
        # Documents that name their images are stored together with photos (Roboflow) or pictures of ids.
        hint = "give the file of names with --names (in Python names=), or use one folder for each kind of masks"
        raise ValueError(f"one of {LAYOUTS}, got {paths[0].name} and {pictures[0]}; {hint}")
    file_names: dict[str, str] = {}  # view -> its file, of data sets
    for (document, image), own_name in zip(images, views, strict=True):
        id_file = _id_file(image.ids, document.path, id_files) if image.ids else None
        name = own_name if id_file is None else tracked_view(id_file, document.path, folder, image.ids)
        if image.file and file_names.setdefault(name, image.file) != image.file:
            got = f"{file_names[name]} and {image.file}, both of the view {name!r}"
            hint = "rotated, cropped or mirrored copies do not match their photo: export without augmentation"
            raise ValueError(f"one image a photo, got {got} in {document.path.name}; {hint}")
        for phrase in image.phrases:
            index.name(name, phrase)
        view = index.view(name, document.path)
        (view.searched if image.annotated else view.not_searched).update(document.phrases)
        index.add(name, document.path, [phrase for phrase, _ in image.masks], partial(_decoded, image.masks))
        if id_file is not None:
            with reading(id_file, InvalidFeatures, "ids [h, w]"):
                _add_tracked(index, name, id_file, image)
    records = [view for (_, image), view in zip(images, views, strict=True) if image.image and not image.file]
    merged = Counter(view for (_, image), view in zip(images, views, strict=True) if image.image)
    return _document_warnings(documents) + [
        f"{merged[view]} files are of one image, {view!r}: their masks are merged"
        for view in sorted(set(records))
        if merged[view] > 1
    ]


def _decoded(masks: Sequence[tuple[str | None, StoredMask]]) -> Masks:
    return ((phrase, mask.pixels()) for phrase, mask in masks)


def _add_tracked(index: _MaskIndex, name: str, path: Path, image: ImageMasks) -> None:
    values = _ids(path)
    unknown = sorted({*np.unique(values).tolist()} - {0, *image.id_phrases})
    if unknown:
        known_ids = ", ".join(map(str, list(image.id_phrases)[:6]))
        raise ValueError(f"the ids of its JSON ({known_ids}), and 0, got the id {unknown[0]}")
    _add_ids(index, name, path, values, image.id_phrases)


def _id_files(images: Images, folder: Path, files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return name without suffix -> files that may contain ids: below the folder, or in a sibling ``mask_data``."""
    sibling_folders = {document.path.parent.parent / MASK_DATA for document, image in images if image.ids}
    outside = [path for path in sorted(sibling_folders) if path.is_dir() and not path.is_relative_to(folder)]
    by_stem: dict[str, list[Path]] = {}
    for path in [*files, *(file for sibling in outside for file in visible_files(sibling))]:
        if path.suffix.lower() in (*ARRAYS, PICTURE):
            by_stem.setdefault(composed(path.stem), []).append(path)
    return by_stem


def _id_file(name: str, document: Path, files: Mapping[str, Sequence[Path]]) -> Path:
    """Return the file of a document's ids; of several with its name, the nearest in the tree of folders."""
    stem = composed(PurePosixPath(name.replace("\\", "/")).stem)
    if stem not in files:
        hint = f"give the folder that contains both, or move {MASK_DATA} next to the folder of the JSON"
        raise ValueError(f"the ids of {document.name} in {stem}.npy, .npz or .png, got no such file; {hint}")
    return min(files[stem], key=lambda path: sum(not path.is_relative_to(parent) for parent in document.parents))


def _views_of(images: Images, folder: Path) -> list[str]:
    """Return the view of each image: of data sets by its relative path, else by its document or its own name."""
    views: list[str] = []
    other_names: dict[int, str] = {}
    for document, image in images:
        own_view, path = _view_of(document.path, folder), without_image_suffix(image.image or "")
        if image.image is None or (not image.file and PurePosixPath(path).name == PurePosixPath(own_view).name):
            views.append(own_view)
            continue
        if not image.file or path.startswith("/") or path[1:3] == ":/":
            other_names[len(views)] = image.image
        views.append(path)
    names = views_of_images([*other_names.values()]) if other_names else {}
    return [names[other_names[place]] if place in other_names else view for place, view in enumerate(views)]


def _document_warnings(documents: Sequence[MaskDocument]) -> list[str]:
    warnings = list[str]()
    for document in documents:
        missing = sum(not image.annotated for image in document.images)
        if missing:
            warnings.append(
                f"{missing} of {len(document.images)} images of {document.path.name} have no annotation and are "
                "omitted; with --unannotated negative they show none of its phrases"
            )
    for name, text in (("boxes", BOXES), ("beyond", BEYOND)):
        counts = {document.path.name: getattr(document, name) for document in documents if getattr(document, name)}
        if counts:
            files = join_names([*counts], 1)
            warnings.append(text.format(count=sum(counts.values()), files=files))
    return warnings
