"""Masks by text prompt, as of SAM 3 and Grounding DINO: regions whose vectors represent phrases.

Phrase k of n has the k-th unit vector of n + 1 channels. Pixels outside of all masks have the last one, as they were
searched and show no phrase. So a lifted feature is the fraction of a splat's weight within the masks of each phrase,
and the cosine to a phrase is near 1 if nearly all of it is. The vectors of the phrases are stored in the pack as a
table, so a lift of it can be queried by these words without an encoder.

A folder contains, with sub-folders if names of views have some (``camA/000``), one of:

* binary pictures, ``PHRASE/VIEW.png`` or, by ``folders="views"``, ``VIEW/PHRASE.png``; ``_`` stands for a space.
  They are PNGs, or arrays [h, w] in ``.npy`` or ``.npz``;
* JSON: data sets of COCO and similar ones, records of one image, or objects by ids (`liftcore.features.mask_json`);
* label pictures ``VIEW.png`` with the names of their values: in a file, or in the picture's text ``legend``, as
  ``splatlift segment --labels`` writes it.

Masks of one phrase in a view are merged. A view counts if it has a file or a record, also of an empty mask. These
pixels have no label: those with the value ``unlabelled``, those within a box without a mask, and those outside of all
masks in a view that was not searched for every phrase.
"""

import csv
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import ViewFolder, files_below
from liftcore.features.mask_files import binary_picture, label_png, panoptic_png
from liftcore.features.mask_json import (
    AS_COCO,
    VOID,
    IdObjects,
    MaskDocument,
    Masks,
    read_mask_document,
    tracked_view,
    views_of_images,
)
from liftcore.io.files import visible_files
from liftcore.io.npy import ARRAYS, NUMBERS, open_array, without_unit_axes
from liftcore.scene.views import composed, require_name, without_image_suffix
from liftcore.text.table import TableEncoder, normalize_text
from liftcore.values.views import NO_LABEL, Regions, label_levels

MAX_PHRASES = 4_096
LEGEND = "legend"  # the text of a label picture that names its values
LAYOUTS = "PHRASE/VIEW.png, VIEW.json with run lengths or polygons, or label pictures VIEW.png with --names"
PICTURE = ".png"
LABELMAP = re.compile(r":[0-9]+,[0-9]+,[0-9]+:.*$")  # after a name in files of CVAT: its colour, parts and actions
VALUE_THEN_NAME = re.compile(r"([0-9]{1,6})(?:\s*[,:;=]\s*|\s+)(.*\S)")
NAME_THEN_VALUE = re.compile(r"(.*\S)\s*[,:;=\t]\s*([0-9]{1,6})")
TABLES = {".csv": ",", ".tsv": "\t"}  # files of names with columns, and their separators
VALUE_COLUMNS = ("id", "value", "pixel value", "idx", "index", "number", "label id")
NAME_COLUMNS = ("name", "class", "class name", "label", "label name", "category", "phrase")
NAME_LISTS = ("id2label", "categories", "classes", "labels", "names")  # of Hugging Face, COCO and others
OTHER_FILES = {
    **dict.fromkeys((".jpg", ".jpeg"), "JPEG blurs the edges of masks: write them as PNG"),
    **dict.fromkeys((".bmp", ".tif", ".tiff", ".webp", ".gif"), "convert them to PNG"),
    **dict.fromkeys((".pt", ".pth"), "save them as .npy: numpy.save(name, mask.cpu().numpy())"),
    ".txt": f"instead of labels of YOLO {AS_COCO}",
    ".xml": f"instead of annotations of CVAT or VOC {AS_COCO}",
}
MASK_DATA = "mask_data"  # folder of Grounded SAM 2's tracking, next to json_data

Folders = Literal["phrases", "views"]
Unannotated = Literal["skip", "negative"]


class _Source(Protocol):
    """A file, or part of one, with masks of a view."""

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        """Read and yield masks [h, w] bool with their phrase, or VOID for unlabelled pixels."""
        ...


@dataclass(frozen=True)
class _BinaryPicture:
    path: Path
    phrase: str
    unlabelled: int | None

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        inside, void = _binary(self.path, self.unlabelled)
        yield self.phrase, inside
        yield VOID, void


@dataclass(frozen=True)
class _Records:
    records: Masks

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        for phrase, mask in self.records:
            yield phrase, mask.pixels()


@dataclass(frozen=True)
class _IdPicture:
    path: Path
    phrases: Mapping[int, str | None]  # value -> phrase; other values show none of the phrases

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        values = _ids(self.path)
        for phrase in dict.fromkeys(self.phrases.values()):
            phrase_values = [value for value, name in self.phrases.items() if name == phrase]
            yield phrase, np.isin(values, phrase_values)


@dataclass
class _View:
    """The masks of a view."""

    file: Path  # the first that names it
    sources: list[_Source] = field(default_factory=list)
    phrases: set[str] = field(default_factory=set)  # normalized, with a pixel
    searched: set[str] = field(default_factory=set)  # normalized, that some document searched for
    not_searched: set[str] = field(default_factory=set)  # normalized, that some document did not search for
    has_void: bool = False
    large_masks: int = 0  # pictures of phrases that cover more than half of it

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
            raise InvalidFeatures(f"view {view!r}", expected="a phrase for each mask", got="an empty phrase")
        require_name(phrase, f"a phrase of the view {view!r}", InvalidFeatures)
        self.phrases.setdefault(key, " ".join(composed(phrase).replace("_", " ").split()))
        return key


@dataclass(frozen=True)
class Prompts:
    """Views of a folder of masks, and the table of their phrases."""

    views: ViewFolder[Regions]
    table: TableEncoder
    counts: Mapping[str, int]  # number of views with a mask of each phrase; phrases with 0 are not in the table
    warnings: tuple[str, ...] = ()  # of omitted images and unlabelled pixels


def prompt_views(
    folder: Path,
    names: Path | None = None,
    folders: Folders = "phrases",
    *,
    unlabelled: int | None = None,
    unannotated: Unannotated = "skip",
) -> Prompts:
    """Open the regions of a folder of masks by phrase (see the module). Each view is read at every access.

    Args:
        folder: of the masks. folders: names of the sub-folders of binary pictures, phrases or views.
        names: of label pictures, JSON from values to names, or a text whose k-th line is the name of value k.
        unlabelled: value of unlabelled pixels in pictures (255).
        unannotated: images of a data set without an annotation: ``skip`` them, or ``negative``, they show no phrase.

    Raises:
        InvalidFeatures: no masks, masks of several kinds, a record without a phrase, or too many phrases. When a view
            is read: a file is malformed, or its masks have several sizes.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected="a folder of masks", got="no such folder")
    value_names = {} if names is None else _read_names(names)
    files = [path for path in files_below(folder) if names is None or not path.samefile(names)]
    documents = [path for path in files if path.suffix.lower() == ".json"]
    pictures = [path for path in files if path.suffix.lower() == PICTURE]
    arrays = [path for path in files if path.suffix.lower() in ARRAYS]
    index, warnings = _MaskIndex(), list[str]()
    if documents:
        parsed_documents = _documents(documents, pictures, value_names, negative=unannotated == "negative")
        if parsed_documents is None:
            got, hint = f"{documents[0].name} and {pictures[0].name}", "or use one folder for each kind of masks"
            raise InvalidFeatures(
                str(folder),
                expected=f"one of {LAYOUTS}",
                got=got,
                hint=f"give the file of names with --names (in Python names=), {hint}",
            )
        if unlabelled is not None:
            raise InvalidFeatures(
                "unlabelled", expected="None without pictures", got=f"{unlabelled} for {documents[0].name}"
            )
        warnings += _add_documents(index, parsed_documents, folder, [*arrays, *pictures])
    elif (arrays and not pictures and names is not None) or (
        pictures and (names is not None or LEGEND in label_texts(pictures[0]))
    ):
        for path in pictures or arrays:
            _add_labels(index, path, _view_of(path, folder), value_names, unlabelled)
    elif pictures or any(len(path.relative_to(folder).parts) > 1 for path in arrays):
        for path in pictures or arrays:
            _add_binary(index, path, path.relative_to(folder), folders, unlabelled)
        warnings += [*_exchanged_folders(index, folders), *_inverted_masks(index)]
    else:
        suffix, count = Counter(path.suffix.lower() for path in files).most_common(1)[0] if files else ("", 0)
        hint = OTHER_FILES.get(suffix, "")
        hint = (
            "give names of ids with --names (in Python names=), or the folder that also contains json_data"
            if arrays
            else hint
        )
        got = f"{len(files)} other files" + (f", {count} of them {suffix}" if suffix else "")
        raise InvalidFeatures(str(folder), expected=f"one of {LAYOUTS}", got=got, hint=hint)
    seen_in = Counter(phrase for view in index.views.values() for phrase in view.phrases)
    order = sorted(seen_in)
    if not 1 <= len(order) <= MAX_PHRASES:
        expected, got = f"1 to {MAX_PHRASES} phrases with masks", f"{len(order)} of {len(index.phrases)} phrases"
        raise InvalidFeatures(str(folder), expected=expected, got=got, hint="; ".join(warnings))
    labelled_views = {
        name: view_masks
        for name, view_masks in index.views.items()
        if view_masks.phrases or view_masks.has_void or view_masks.was_searched(order)
    }
    partly = sum(not view_masks.was_searched(order) for view_masks in labelled_views.values())
    if partly:
        warnings.append(
            f"{partly} of {len(labelled_views)} views were not searched for every phrase, according to their files: "
            "pixels outside of all masks have no label there"
        )
    rows = {phrase: row for row, phrase in enumerate(order)}
    vectors = np.eye(len(order) + 1, dtype=np.float16)

    def read_view(name: str) -> Regions:
        return _regions(name, labelled_views[name], rows, vectors)

    views = ViewFolder({name: view_masks.file for name, view_masks in labelled_views.items()}, read_view, files)
    table = TableEncoder("phrases", [index.phrases[phrase] for phrase in order], vectors[:-1])
    counts = {text: seen_in[phrase] for phrase, text in sorted(index.phrases.items())}
    return Prompts(views, table, counts, tuple(warnings))


def _exchanged_folders(index: _MaskIndex, folders: Folders) -> list[str]:
    """Return a warning if phrases are numbered like photos, and views are not."""
    phrases, views = [*index.phrases.values()], [*index.views]
    if not _is_numbered(phrases) or _is_numbered(views):
        return []
    way, other = ("VIEW/PHRASE", "views") if folders == "phrases" else ("PHRASE/VIEW", "phrases")
    examples = f"phrases are {', '.join(phrases[:2])}, ... and views {', '.join(views[:2])}"
    return [f"{examples}: for files {way}.png give --folders {other}"]


def _inverted_masks(index: _MaskIndex) -> list[str]:
    """Return a warning if several phrases cover most of most views, as masks in black on white do."""
    inverted = sum(view.large_masks > 1 for view in index.views.values())
    if 2 * inverted <= len(index.views):
        return []
    return [
        f"in {inverted} of {len(index.views)} views two or more phrases cover over half of the picture each: a mask "
        "is the pixels that are not black; invert masks that are black on white"
    ]


def _is_numbered(names: Sequence[str]) -> bool:
    """Return True if names differ only by their numbers."""
    return len(names) > 1 and len({re.sub(r"[0-9]+", "0", name) for name in names}) == 1


def label_texts(path: Path) -> dict[str, str]:
    """Read the texts of a label picture; empty for other files."""
    try:
        return label_png(path)[1]
    except InvalidFeatures:
        return {}


def _regions(name: str, view: _View, rows: Mapping[str, int], vectors: np.ndarray) -> Regions:
    masks: dict[str, np.ndarray] = {}
    void: np.ndarray | None = None
    for phrase, mask in (pair for source in view.sources for pair in source.masks()):
        size = next(iter(masks.values()), mask if void is None else void).shape
        if mask.shape != size:
            got = f"{size[0]} x {size[1]} and {mask.shape[0]} x {mask.shape[1]}"
            raise InvalidFeatures(
                f"view {name!r}", expected="masks of one size", got=got, hint="write the masks of one photo"
            )
        if phrase is None:
            void = mask if void is None else void | mask
        elif (key := normalize_text(phrase)) in view.phrases:
            masks[key] = masks[key] | mask if key in masks else mask
    if masks:
        labels = label_levels(list(masks.values()), str(view.file))
    else:
        labels = np.full((1, 1, 1) if void is None else (1, *void.shape), NO_LABEL, np.int32)
    if view.was_searched(rows):
        rest = (labels == NO_LABEL).all(axis=0)
        labels[0][rest if void is None else rest & ~void] = len(masks)
    return Regions(labels, vectors[[*(rows[phrase] for phrase in masks), len(rows)]], context=f"view {name!r}")


def _view_of(path: Path, folder: Path) -> str:
    return without_image_suffix(path.relative_to(folder).with_suffix("").as_posix())


def _binary(path: Path, unlabelled: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture or an array: [h, w] bool, the mask, and the unlabelled pixels."""
    if path.suffix.lower() == PICTURE:
        return binary_picture(path, unlabelled)
    values = _plane(open_array(path, kinds=NUMBERS + "b"), path)
    void = np.zeros(values.shape, bool) if unlabelled is None else values == unlabelled
    inside = (values != 0) & ~void
    if len(inside_values := np.unique(values[inside])) > 1:
        got, hint = (
            f"values from {inside_values[0]} to {inside_values[-1]} besides 0",
            "save scores or logits above a threshold",
        )
        raise InvalidFeatures(str(path), expected="one value besides 0, a mask", got=got, hint=hint)
    return inside, void


def _ids(path: Path) -> np.ndarray:
    """Read a picture or an array of ids, [h, w] integers."""
    if path.suffix.lower() == PICTURE:
        return panoptic_png(path)
    return _plane(open_array(path, kinds=NUMBERS), path).astype(np.int64)


def _plane(values: np.ndarray, path: Path) -> np.ndarray:
    """Remove leading axes of length 1, or the last one, of an array: [h, w]."""
    plane = without_unit_axes(values, 3)
    plane = plane[..., 0] if plane.ndim == 3 and plane.shape[-1] == 1 else without_unit_axes(plane, 2)
    if plane.ndim != 2:
        got = f"{values.dtype} {list(values.shape)}"
        raise InvalidFeatures(str(path), expected="a mask or ids [h, w]", got=got)
    return plane


def _add_binary(index: _MaskIndex, path: Path, inner: Path, folders: Folders, unlabelled: int | None) -> None:
    parts = PurePosixPath(inner.with_suffix("").as_posix()).parts
    if len(parts) < 2:
        raise InvalidFeatures(
            str(path), expected=LAYOUTS, got="a picture outside of folders of phrases, without names"
        )
    phrase, inside = (parts[0], parts[1:]) if folders == "phrases" else (parts[-1], parts[:-1])
    name = without_image_suffix("/".join(inside))
    view, key = index.view(name, path), index.name(name, phrase)
    mask, void = _binary(path, unlabelled)
    if mask.any() or void.any():
        view.sources.append(_BinaryPicture(path, phrase, unlabelled))
        view.has_void = view.has_void or bool(void.any())
    if mask.any():
        view.phrases.add(key)
    view.large_masks += bool(mask.mean() > 1 / 2)


def _add_labels(index: _MaskIndex, path: Path, name: str, names: Mapping[int, str], unlabelled: int | None) -> None:
    values, texts = label_png(path) if path.suffix.lower() == PICTURE else (_ids(path), {})
    phrases: dict[int, str | None] = dict(
        names or _names_of_json(_parse_json(texts.get(LEGEND, "null")), f"{path} legend")
    )
    if unlabelled is not None:
        phrases[unlabelled] = VOID
    named_values = [value for value in phrases if value]
    for value in np.unique(values[(values != 0) | (unlabelled == 0)]).tolist():
        if value not in phrases:
            expected = f"a name for each value except 0 ({', '.join(map(str, named_values[:6]))})"
            option = f"--unlabelled {value} (in Python unlabelled={value})"
            hint = f"if it marks unlabelled pixels, give {option}"
            raise InvalidFeatures(str(path), expected=expected, got=f"the value {value}", hint=hint)
    _add_ids(index, index.view(name, path), name, path, values, phrases)


def _add_ids(
    index: _MaskIndex, view: _View, name: str, path: Path, values: np.ndarray, phrases: Mapping[int, str | None]
) -> None:
    present = {value: phrases[value] for value in np.unique(values).tolist() if value in phrases}
    present = {value: phrase for value, phrase in present.items() if value or phrase is None}
    if present:
        view.sources.append(_IdPicture(path, present))
    view.has_void = view.has_void or VOID in present.values()
    view.phrases.update(index.name(name, phrase) for phrase in present.values() if phrase is not None)


def _read_names(path: Path) -> dict[int, str]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidFeatures("names", expected="a file of names", got=str(error)[:120]) from None
    suffix = path.suffix.lower()
    if suffix in (".yml", ".yaml"):
        hint = 'write its values and names as JSON, {"1": "red mug"}; 0 is outside of all masks'
        raise InvalidFeatures("names", expected="JSON, a table (.csv, .tsv) or a text", got=path.name, hint=hint)
    if suffix == ".json":
        return _names_of_json(_parse_json(text), str(path))
    names = _names_of_table(text, TABLES[suffix], path) if suffix in TABLES else _names_of_lines(text.splitlines())
    if not names:
        raise InvalidFeatures("names", expected="a file of names", got=f"none in {path.name}")
    return names


def _names_of_table(text: str, separator: str, path: Path) -> dict[int, str]:
    """Read names by value from a table: its columns with such headers, or its only two, in any order.

    In a single column, the k-th name belongs to value k, as for lines.
    """
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator)]
    rows = [row for row in rows if any(row)]
    if all(len(row) == 1 for row in rows):
        return _names_of_lines([row[0] for row in rows])
    has_header = bool(rows) and not any(map(str.isdecimal, rows[0]))
    header = [cell.lower().replace("_", " ") for cell in rows[0]] if has_header else []
    columns = [*zip(*rows[has_header:], strict=False)]
    values = [index for index, column in enumerate(columns) if all(map(str.isdecimal, column))]
    value = next((index for index in values if header and header[index] in VALUE_COLUMNS), None)
    name = next(
        (header.index(header_name) for header_name in NAME_COLUMNS if header_name in header[: len(columns)]), None
    )
    if len(columns) == 2 and len(values) == 1:
        value, name = values[0], 1 - values[0]
    if value is None or name is None or name == value:
        got = f"columns {', '.join(header or rows[0])}"[:80]
        raise InvalidFeatures(str(path), expected="a column 'id' of values and one 'name'", got=got)
    return {int(row[value]): row[name] for row in zip(*columns, strict=True) if row[name]}


def _names_of_lines(lines: Sequence[str]) -> dict[int, str]:
    """Read names by value from lines: the k-th is the name of value k, unless the lines contain values.

    A first line ``background`` (``_background_`` of LabelMe) is the name of 0. Lines that begin with ``#`` and
    LabelMe's ``__ignore__`` are skipped; in CVAT's ``labelmap.txt``, ``red mug:128,0,0::``, only the name counts.
    Values are before the names or, with a separator, after distinct names; a first line without a value is a header.
    """
    names = [line.strip() for line in lines if not line.lstrip().startswith("#") and line.strip() != "__ignore__"]
    names = [LABELMAP.sub("", line) for line in names]
    for pattern, value, name in ((VALUE_THEN_NAME, 1, 2), (NAME_THEN_VALUE, 2, 1)):
        matches = [pattern.fullmatch(line) for line in names if line]
        pairs = {int(match[value]): match[name] for match in matches if match}
        is_numbered = bool(matches[1:]) and all(matches[1:]) and len(pairs) >= len(matches) - (matches[0] is None)
        if is_numbered and (name > value or len({*pairs.values()}) == len(pairs)):
            return pairs
    first = 0 if names and names[0].strip("_").lower() == "background" else 1
    return {value: line for value, line in enumerate(names, start=first) if line}


def _parse_json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _names_of_json(content: Any, location: str) -> dict[int, str]:
    """Read names by value from JSON: from values to names or from names to values, or a list.

    A list is read like lines (`_names_of_lines`), unless it has COCO's categories, ``id`` and ``name``. Of an object
    with one of NAME_LISTS, only this list is read.
    """
    if isinstance(content, dict):
        content = next((content[key] for key in NAME_LISTS if isinstance(content.get(key), dict | list)), content)
    is_inverse = isinstance(content, dict) and not any(str(name).strip().isdecimal() for name in content)
    if is_inverse and content and all(type(value) is int for value in content.values()):
        content = {value: name for name, value in content.items()}
    elif isinstance(content, list) and content and all(isinstance(entry, dict) for entry in content):
        content = {entry.get("id"): entry.get("name") for entry in content}
    if isinstance(content, list):
        content = _names_of_lines(content) if all(isinstance(name, str) for name in content) else {}
    try:
        names = {int(value): _name_in(name) for value, name in content.items()} if isinstance(content, dict) else {}
    except (TypeError, ValueError):
        names = {}
    if not names or not all(isinstance(name, str) and name.strip() for name in names.values()):
        raise InvalidFeatures(location, expected='JSON of values and names, {"1": "red mug"}', got="none")
    return names


def _name_in(entry: Any) -> Any:
    """Return the name of an entry, which may be an object with a name."""
    return entry.get("name") if isinstance(entry, dict) else entry


def _documents(
    paths: Sequence[Path], pictures: Sequence[Path], names: Mapping[int, str], *, negative: bool
) -> list[MaskDocument] | None:
    """Read the documents; None if there are also pictures that may be masks."""
    try:
        documents = [read_mask_document(path, names, unannotated_negative=negative) for path in paths]
    except InvalidFeatures:
        if pictures:
            return None
        raise
    # Documents that name their images are stored together with photos (Roboflow) or pictures of ids.
    all_name_images = all(
        image.image is not None or image.ids is not None for document in documents for image in document.images
    )
    return None if pictures and not all_name_images else documents


def _add_documents(
    index: _MaskIndex, documents: Sequence[MaskDocument], folder: Path, ids: Sequence[Path]
) -> list[str]:
    """Add the masks of all documents, and return warnings."""
    views, id_files = _document_views(documents, folder), _id_files(documents, folder, ids)
    file_names: dict[str, str] = {}  # view -> its file, of data sets
    for document, image in ((source, image) for source in documents for image in source.images):
        id_file = None if image.ids is None else _id_file(image.ids, document.path, id_files)
        if id_file is not None and image.image is None:
            name = tracked_view(id_file, document.path, folder, image.ids.name if image.ids else "")
        else:
            name = views[document.path, image.image]
        if image.file and file_names.setdefault(name, image.file) != image.file:
            got = f"{file_names[name]} and {image.file}, both of the view {name!r}"
            hint = "rotated, cropped or mirrored copies do not match their photo: export without augmentation"
            raise InvalidFeatures(str(document.path), expected="one image a photo", got=got, hint=hint)
        view = index.view(name, document.path)
        view.searched |= image.searched
        view.not_searched |= image.not_searched
        for phrase in image.phrases:
            index.name(name, phrase)
        if image.masks:
            view.sources.append(_Records(image.masks))
            view.phrases.update(normalize_text(phrase) for phrase, _ in image.masks if phrase is not None)
            view.has_void = view.has_void or any(phrase is None for phrase, _ in image.masks)
        if id_file is not None and image.ids is not None:
            _add_named_ids(index, view, name, id_file, image.ids)
    return _document_warnings(documents, views)


def _add_named_ids(index: _MaskIndex, view: _View, name: str, path: Path, objects: IdObjects) -> None:
    values = _ids(path)
    unknown = sorted({*np.unique(values).tolist()} - {0, *objects.phrases})
    if unknown:
        known_ids = ", ".join(map(str, list(objects.phrases)[:6]))
        raise InvalidFeatures(
            str(path), expected=f"the ids of its JSON ({known_ids}), and 0", got=f"the id {unknown[0]}"
        )
    _add_ids(index, view, name, path, values, objects.phrases)


def _id_files(documents: Sequence[MaskDocument], folder: Path, files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return name without suffix -> files that may contain ids: below the folder, or in a sibling ``mask_data``."""
    sibling_folders = {document.path.parent.parent / MASK_DATA for document in documents if document.has_ids()}
    outside = [path for path in sorted(sibling_folders) if path.is_dir() and not path.is_relative_to(folder)]
    by_stem: dict[str, list[Path]] = {}
    for path in [*files, *(file for sibling in outside for file in visible_files(sibling))]:
        if path.suffix.lower() in (*ARRAYS, PICTURE):
            by_stem.setdefault(composed(path.stem), []).append(path)
    return by_stem


def _id_file(objects: IdObjects, document: Path, files: Mapping[str, Sequence[Path]]) -> Path:
    """Return the file of a document's ids; of several with its name, the nearest in the tree of folders."""
    stem = composed(PurePosixPath(objects.name.replace("\\", "/")).stem)
    if stem not in files:
        hint = f"give the folder that contains both, or move {MASK_DATA} next to the folder of the JSON"
        expected = f"its ids in {stem}.npy, .npz or .png"
        raise InvalidFeatures(str(document), expected=expected, got="no such file", hint=hint)
    return min(files[stem], key=lambda path: sum(not path.is_relative_to(parent) for parent in document.parents))


def _document_views(documents: Sequence[MaskDocument], folder: Path) -> dict[tuple[Path, str | None], str]:
    """Return (document, image) -> view.

    Images of data sets keep the folders of their relative paths. A document of one image belongs to the view with its
    own name, unless it names another image.
    """
    views: dict[tuple[Path, str | None], str] = {}
    by_path: dict[tuple[Path, str], str] = {}
    for document, image in ((source, image) for source in documents for image in source.images):
        document_view, name = _view_of(document.path, folder), image.image
        if name is None:
            views[document.path, None] = document_view
            continue
        path = without_image_suffix(name)
        if image.in_data_set and not _is_absolute(path):
            views[document.path, name] = path
        elif not image.in_data_set and PurePosixPath(path).name == PurePosixPath(document_view).name:
            views[document.path, name] = document_view
        else:
            by_path[document.path, name] = name
    if by_path:
        image_views = views_of_images([*by_path.values()])
        views.update({key: image_views[name] for key, name in by_path.items()})
    return views


def _names_of(files: Sequence[Path]) -> str:
    return files[0].name if len(files) == 1 else f"{len(files)} files ({files[0].name}, ...)"


def _is_absolute(path: str) -> bool:
    return path.startswith("/") or path[1:3] == ":/"


def _document_warnings(documents: Sequence[MaskDocument], views: Mapping[tuple[Path, str | None], str]) -> list[str]:
    warnings = list[str]()
    for document in documents:
        data_set_views = {
            views[document.path, image_masks.image]
            for image_masks in document.images
            if image_masks.in_data_set and image_masks.image
        }
        annotated_views = {
            views[document.path, image_masks.image]
            for image_masks in document.images
            if image_masks.annotated and image_masks.in_data_set
        }
        if missing := len(data_set_views - annotated_views):
            warnings.append(
                f"{missing} of {len(data_set_views)} images of {document.path.name} have no annotation and are "
                "omitted; with --unannotated negative they show none of its phrases"
            )
    if boxes := [document for document in documents if document.boxes]:
        count, names = sum(document.boxes for document in boxes), _names_of([document.path for document in boxes])
        warnings.append(
            f"{count} annotations of {names} have at most a box and no mask: pixels in the boxes have no label; "
            "create masks from the boxes, for example with SAM"
        )
    beyond = {document.path: count for document in documents if (count := document.beyond())}
    if beyond:
        warnings.append(
            f"{sum(beyond.values())} polygons of {_names_of([*beyond])} extend beyond their images and are "
            "clipped: width and height must be those of the annotated photos"
        )
    several = Counter(view for (_, image), view in views.items() if image is not None)
    single_image_views = {
        views[document.path, image.image]
        for document in documents
        for image in document.images
        if image.image is not None and not image.in_data_set
    }
    for view in sorted(view for view in single_image_views if several[view] > 1):
        warnings.append(f"{several[view]} files are of one image, {view!r}: their masks are merged")
    return warnings
