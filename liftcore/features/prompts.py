"""Masks that a text prompt made, as SAM 3 and Grounding DINO give them: regions whose vectors stand for phrases.

Phrase k of n has the k-th unit vector of n + 1 channels. What no phrase's mask covers has the last one: it was looked
at, and is none of them. So a lifted splat's feature holds the share of its light that each phrase's masks took, and
the cosine to a phrase is near 1 where nearly all of it lies in them. The vectors of the phrases go into the pack as a
table, and a lift of it is asked in these words without an encoder.

A folder holds, with sub-folders where views have some (``camA/000``), one of:

* binary pictures, ``PHRASE/VIEW.png`` or, by ``folders="views"``, ``VIEW/PHRASE.png``; ``_`` stands for a space.
  They are PNGs, or arrays [h, w] in ``.npy`` or ``.npz``;
* JSON: COCO's data sets and their kin, records of one image, or objects by ids (`liftcore.features.mask_json`);
* label pictures ``VIEW.png`` with the names of their values: in a file, or in the picture's text ``legend``, as
  ``splatlift segment --labels`` writes it.

Masks of one phrase in a view are put together. A view counts once it has a file or a record, if only of an empty
mask. A pixel has no label where nobody decided what it shows: what ``unlabelled`` marks, what lies in a box without a
mask, and all that no mask covers in a view that was not searched for every phrase.
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

MOST_PHRASES = 4_096
LEGEND = "legend"  # the text of a label picture that names its values
LAYOUTS = "PHRASE/VIEW.png, VIEW.json with run lengths or polygons, or label pictures VIEW.png with --names"
PICTURE = ".png"
LABELMAP = re.compile(r":[0-9]+,[0-9]+,[0-9]+:.*$")  # what CVAT writes behind a name: its colour, parts and actions
NUMBERED = re.compile(r"([0-9]{1,6})(?:\s*[,:;=]\s*|\s+)(.*\S)")
NAMED = re.compile(r"(.*\S)\s*[,:;=\t]\s*([0-9]{1,6})")
TABLES = {".csv": ",", ".tsv": "\t"}  # files of names with columns, and what parts these
VALUE_COLUMNS = ("id", "value", "pixel value", "idx", "index", "number", "label id")
NAME_COLUMNS = ("name", "class", "class name", "label", "label name", "category", "phrase")
NAME_LISTS = ("id2label", "categories", "classes", "labels", "names")  # of Hugging Face, COCO and others
OTHER_FILES = {
    **dict.fromkeys((".jpg", ".jpeg"), "JPEG blurs the edges of masks: write them as PNG"),
    **dict.fromkeys((".bmp", ".tif", ".tiff", ".webp", ".gif"), "convert them to PNG"),
    **dict.fromkeys((".pt", ".pth"), "save them as .npy: numpy.save(name, mask.cpu().numpy())"),
    ".txt": f"of labels of YOLO {AS_COCO}",
    ".xml": f"of annotations of CVAT or VOC {AS_COCO}",
}
MASK_DATA = "mask_data"  # of Grounded SAM 2's tracking, beside json_data

Folders = Literal["phrases", "views"]
Unannotated = Literal["skip", "negative"]


class _Source(Protocol):
    """A file, or part of one, with masks of a view."""

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        """Phrases, or VOID for what nobody decided, with [h, w] bool; read when they are asked for."""
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
    phrases: Mapping[int, str | None]  # value -> phrase; values that are not here are none of the phrases

    def masks(self) -> Iterator[tuple[str | None, np.ndarray]]:
        values = _ids(self.path)
        for phrase in dict.fromkeys(self.phrases.values()):
            own = [value for value, other in self.phrases.items() if other == phrase]
            yield phrase, np.isin(values, own)


@dataclass
class _View:
    """The masks of a view."""

    file: Path  # the first that names it
    sources: list[_Source] = field(default_factory=list)
    phrases: set[str] = field(default_factory=set)  # plain, that have a pixel
    decided: set[str] = field(default_factory=set)  # plain, that it was searched for
    undecided: set[str] = field(default_factory=set)  # plain, that some document did not search it for
    has_void: bool = False
    filled: int = 0  # pictures of phrases that cover more than half of it

    def was_searched(self, phrases: Iterable[str]) -> bool:
        """Return whether each of these phrases is masked wherever it is."""
        return not (self.undecided - self.decided).intersection(phrases)


@dataclass
class _MaskIndex:
    """Where the masks of each view are, by phrase."""

    phrases: dict[str, str] = field(default_factory=dict)  # as tables compare them -> as it was said first
    views: dict[str, _View] = field(default_factory=dict)

    def view(self, name: str, path: Path) -> _View:
        """A view that a file names."""
        require_name(name, f"the view of {str(path)!a}", InvalidFeatures)
        return self.views.setdefault(name, _View(path))

    def name(self, view: str, phrase: str) -> str:
        """The plain form of a phrase of a view, which is known from then on."""
        if not (key := normalize_text(phrase)):
            raise InvalidFeatures(f"view {view!r}", expected="a phrase for each mask", got="an empty one")
        require_name(phrase, f"a phrase of the view {view!r}", InvalidFeatures)
        self.phrases.setdefault(key, " ".join(composed(phrase).replace("_", " ").split()))
        return key


@dataclass(frozen=True)
class Prompts:
    """Views of a folder of masks, and the table of their phrases."""

    views: ViewFolder[Regions]
    table: TableEncoder
    counts: Mapping[str, int]  # in how many views each phrase has a mask; one that has none is not in the table
    warnings: tuple[str, ...] = ()  # of what was left out, and of what no mask decides


def prompt_views(
    folder: Path,
    names: Path | None = None,
    folders: Folders = "phrases",
    *,
    unlabelled: int | None = None,
    unannotated: Unannotated = "skip",
) -> Prompts:
    """The regions of a folder of masks by phrase (above); each view is read when it is asked for.

    Args:
        folder: the folder. folders: what its sub-folders of binary pictures are named by.
        names: of label pictures, JSON from values to names, or a text whose k-th line names the value k.
        unlabelled: of pictures, the value of pixels of which nobody decided what they show (255).
        unannotated: whether images of a data set without an annotation are left out, or show none of its phrases.

    Raises:
        InvalidFeatures: there are no masks, kinds of them are mixed, a record has no phrase, or there are too many
            phrases. Reading a view: a file is malformed, or its masks have several sizes.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected="a folder of masks", got="no such folder")
    named = {} if names is None else _names(names)
    files = [path for path in files_below(folder) if names is None or not path.samefile(names)]
    documents = [path for path in files if path.suffix.lower() == ".json"]
    pictures = [path for path in files if path.suffix.lower() == PICTURE]
    arrays = [path for path in files if path.suffix.lower() in ARRAYS]
    index, warnings = _MaskIndex(), list[str]()
    if documents:
        read = _documents(documents, pictures, named, negative=unannotated == "negative")
        if read is None:
            got, hint = f"{documents[0].name} and {pictures[0].name}", "or keep kinds of masks apart"
            raise InvalidFeatures(
                str(folder),
                expected=f"one of {LAYOUTS}",
                got=got,
                hint=f"name the file of names with --names (in Python names=), {hint}",
            )
        if unlabelled is not None:
            raise InvalidFeatures("unlabelled", expected="pictures, whose values it is of", got=documents[0].name)
        warnings += _add_documents(index, read, folder, [*arrays, *pictures])
    elif (arrays and not pictures and names is not None) or (
        pictures and (names is not None or LEGEND in label_texts(pictures[0]))
    ):
        for path in pictures or arrays:
            _add_labels(index, path, _view_of(path, folder), named, unlabelled)
    elif pictures or any(len(path.relative_to(folder).parts) > 1 for path in arrays):
        for path in pictures or arrays:
            _add_binary(index, path, path.relative_to(folder), folders, unlabelled)
        warnings += [*_exchanged_folders(index, folders), *_inverted_masks(index)]
    else:
        suffix, count = Counter(path.suffix.lower() for path in files).most_common(1)[0] if files else ("", 0)
        hint = OTHER_FILES.get(suffix, "")
        hint = (
            "ids need their names: give --names (in Python names=), or the folder that holds json_data too"
            if arrays
            else hint
        )
        got = f"{len(files)} other files" + (f", {count} of them {suffix}" if suffix else "")
        raise InvalidFeatures(str(folder), expected=f"one of {LAYOUTS}", got=got, hint=hint)
    seen_in = Counter(phrase for view in index.views.values() for phrase in view.phrases)
    order = sorted(seen_in)
    if not 1 <= len(order) <= MOST_PHRASES:
        expected, got = f"1 to {MOST_PHRASES} phrases with masks", f"{len(order)} of {len(index.phrases)} phrases"
        raise InvalidFeatures(str(folder), expected=expected, got=got, hint="; ".join(warnings))
    told = {name: one for name, one in index.views.items() if one.phrases or one.has_void or one.was_searched(order)}
    partly = sum(not one.was_searched(order) for one in told.values())
    if partly:
        warnings.append(
            f"{partly} of {len(told)} views were not searched for every phrase, as their files say: what no mask "
            "covers has no label there"
        )
    rows = {phrase: row for row, phrase in enumerate(order)}
    vectors = np.eye(len(order) + 1, dtype=np.float16)

    def read_view(name: str) -> Regions:
        return _regions(name, told[name], rows, vectors)

    views = ViewFolder({name: one.file for name, one in told.items()}, read_view, files)
    table = TableEncoder("phrases", [index.phrases[phrase] for phrase in order], vectors[:-1])
    counts = {said: seen_in[phrase] for phrase, said in sorted(index.phrases.items())}
    return Prompts(views, table, counts, tuple(warnings))


def _exchanged_folders(index: _MaskIndex, folders: Folders) -> list[str]:
    """A warning where phrases are numbered as photos are, and views are not."""
    phrases, views = [*index.phrases.values()], [*index.views]
    if not _is_numbered(phrases) or _is_numbered(views):
        return []
    way, other = ("VIEW/PHRASE", "views") if folders == "phrases" else ("PHRASE/VIEW", "phrases")
    some = f"phrases are {', '.join(phrases[:2])}, ... and views {', '.join(views[:2])}"
    return [f"{some}: of {way}.png give --folders {other}"]


def _inverted_masks(index: _MaskIndex) -> list[str]:
    """A warning where several phrases fill most of most views at once, as masks in black on white do."""
    inverted = sum(view.filled > 1 for view in index.views.values())
    if 2 * inverted <= len(index.views):
        return []
    return [
        f"in {inverted} of {len(index.views)} views two or more phrases cover over half of the picture each: a mask "
        "is what is not black; invert masks that are black on white"
    ]


def _is_numbered(names: Sequence[str]) -> bool:
    """Return whether names differ by their numbers alone."""
    return len(names) > 1 and len({re.sub(r"[0-9]+", "0", name) for name in names}) == 1


def label_texts(path: Path) -> dict[str, str]:
    """The texts of a label picture; none of what is no such picture."""
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
            raise InvalidFeatures(f"view {name!r}", expected="masks of one size", got=got, hint="those of one photo")
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
    return Regions(labels, vectors[[*(rows[phrase] for phrase in masks), len(rows)]], where=f"view {name!r}")


def _view_of(path: Path, folder: Path) -> str:
    return without_image_suffix(path.relative_to(folder).with_suffix("").as_posix())


def _binary(path: Path, unlabelled: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Where a mask of a picture or an array is, and where nobody decided, [h, w] bool both."""
    if path.suffix.lower() == PICTURE:
        return binary_picture(path, unlabelled)
    values = _plane(open_array(path, kinds=NUMBERS + "b"), path)
    void = np.zeros(values.shape, bool) if unlabelled is None else values == unlabelled
    inside = (values != 0) & ~void
    if len(told := np.unique(values[inside])) > 1:
        got, hint = f"values from {told[0]} to {told[-1]} beside it", "of scores or logits save where they are high"
        raise InvalidFeatures(str(path), expected="one value beside 0, a mask", got=got, hint=hint)
    return inside, void


def _ids(path: Path) -> np.ndarray:
    """[h, w] integers of a picture or an array of ids."""
    if path.suffix.lower() == PICTURE:
        return panoptic_png(path)
    return _plane(open_array(path, kinds=NUMBERS), path).astype(np.int64)


def _plane(values: np.ndarray, path: Path) -> np.ndarray:
    """[h, w] of an array with axes of length 1 before, or one behind."""
    found = without_unit_axes(values, 3)
    found = found[..., 0] if found.ndim == 3 and found.shape[-1] == 1 else without_unit_axes(found, 2)
    if found.ndim != 2:
        got = f"{values.dtype} {list(values.shape)}"
        raise InvalidFeatures(str(path), expected="a mask or ids [h, w]", got=got)
    return found


def _add_binary(index: _MaskIndex, path: Path, inner: Path, folders: Folders, unlabelled: int | None) -> None:
    parts = PurePosixPath(inner.with_suffix("").as_posix()).parts
    if len(parts) < 2:
        raise InvalidFeatures(str(path), expected=LAYOUTS, got="a picture in no phrase's folder and without names")
    phrase, inside = (parts[0], parts[1:]) if folders == "phrases" else (parts[-1], parts[:-1])
    name = without_image_suffix("/".join(inside))
    view, key = index.view(name, path), index.name(name, phrase)
    mask, void = _binary(path, unlabelled)
    if mask.any() or void.any():
        view.sources.append(_BinaryPicture(path, phrase, unlabelled))
        view.has_void = view.has_void or bool(void.any())
    if mask.any():
        view.phrases.add(key)
    view.filled += bool(mask.mean() > 1 / 2)


def _add_labels(index: _MaskIndex, path: Path, name: str, names: Mapping[int, str], unlabelled: int | None) -> None:
    values, texts = label_png(path) if path.suffix.lower() == PICTURE else (_ids(path), {})
    phrases: dict[int, str | None] = dict(names or _numbered(_parsed(texts.get(LEGEND, "null")), f"{path} legend"))
    if unlabelled is not None:
        phrases[unlabelled] = VOID
    known = [value for value in phrases if value]
    for value in np.unique(values[(values != 0) | (unlabelled == 0)]).tolist():
        if value not in phrases:
            expected = f"a name for each value but 0 ({', '.join(map(str, known[:6]))})"
            option = f"--unlabelled {value} (in Python unlabelled={value})"
            hint = f"where it marks pixels that nobody decided on, give {option}"
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


def _names(path: Path) -> dict[int, str]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidFeatures("names", expected="a file of names", got=str(error)[:120]) from None
    suffix = path.suffix.lower()
    if suffix in (".yml", ".yaml"):
        hint = 'write its values and names as JSON, {"1": "red mug"}; 0 is what no mask covers'
        raise InvalidFeatures("names", expected="JSON, a table (.csv, .tsv) or a text", got=path.name, hint=hint)
    if suffix == ".json":
        return _numbered(_parsed(text), str(path))
    found = _tabled(text, TABLES[suffix], path) if suffix in TABLES else _listed(text.splitlines())
    if not found:
        raise InvalidFeatures("names", expected="a file of names", got=f"none in {path.name}")
    return found


def _tabled(text: str, separator: str, path: Path) -> dict[int, str]:
    """Names by their values, of a table: columns that its first row calls so, or its only two, in any order.

    Of a single column the k-th name is of the value k, as of lines.
    """
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator)]
    rows = [row for row in rows if any(row)]
    if all(len(row) == 1 for row in rows):
        return _listed([row[0] for row in rows])
    has_header = bool(rows) and not any(map(str.isdecimal, rows[0]))
    header = [cell.lower().replace("_", " ") for cell in rows[0]] if has_header else []
    columns = [*zip(*rows[has_header:], strict=False)]
    values = [place for place, column in enumerate(columns) if all(map(str.isdecimal, column))]
    value = next((place for place in values if header and header[place] in VALUE_COLUMNS), None)
    name = next((header.index(known) for known in NAME_COLUMNS if known in header[: len(columns)]), None)
    if len(columns) == 2 and len(values) == 1:
        value, name = values[0], 1 - values[0]
    if value is None or name is None or name == value:
        got = f"columns {', '.join(header or rows[0])}"[:80]
        raise InvalidFeatures(str(path), expected="a column 'id' of values and one 'name'", got=got)
    return {int(row[value]): row[name] for row in zip(*columns, strict=True) if row[name]}


def _listed(lines: Sequence[str]) -> dict[int, str]:
    """Names by their values, of lines: the k-th names the value k, unless the lines have numbers of their own.

    A first line ``background`` (``_background_`` of LabelMe) names 0. Lines that begin with ``#`` are none, nor is
    LabelMe's ``__ignore__``; of CVAT's ``labelmap.txt``, ``red mug:128,0,0::``, the name counts. Numbers stand before
    the names or, behind a separator, after different ones; a first line without one is a header.
    """
    named = [line.strip() for line in lines if not line.lstrip().startswith("#") and line.strip() != "__ignore__"]
    named = [LABELMAP.sub("", line) for line in named]
    for pattern, value, name in ((NUMBERED, 1, 2), (NAMED, 2, 1)):
        found = [pattern.fullmatch(line) for line in named if line]
        pairs = {int(match[value]): match[name] for match in found if match}
        is_whole = bool(found[1:]) and all(found[1:]) and len(pairs) >= len(found) - (found[0] is None)
        if is_whole and (name > value or len({*pairs.values()}) == len(pairs)):
            return pairs
    first = 0 if named and named[0].strip("_").lower() == "background" else 1
    return {value: line for value, line in enumerate(named, start=first) if line}


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _numbered(told: Any, where: str) -> dict[int, str]:
    """Names by their values, of JSON from values to names or from names to values, or of a list.

    A list names values as lines do (`_listed`), unless it is of COCO's categories, ``id`` and ``name``. Of an object
    with one of NAME_LISTS that counts.
    """
    if isinstance(told, dict):
        told = next((told[key] for key in NAME_LISTS if isinstance(told.get(key), dict | list)), told)
    is_inverse = isinstance(told, dict) and not any(str(name).strip().isdecimal() for name in told)
    if is_inverse and told and all(type(value) is int for value in told.values()):
        told = {value: name for name, value in told.items()}
    elif isinstance(told, list) and told and all(isinstance(one, dict) for one in told):
        told = {one.get("id"): one.get("name") for one in told}
    if isinstance(told, list):
        told = _listed(told) if all(isinstance(name, str) for name in told) else {}
    try:
        named = {int(value): _name_in(name) for value, name in told.items()} if isinstance(told, dict) else {}
    except (TypeError, ValueError):
        named = {}
    if not named or not all(isinstance(name, str) and name.strip() for name in named.values()):
        raise InvalidFeatures(where, expected='JSON of values and names, {"1": "red mug"}', got="none")
    return named


def _name_in(entry: Any) -> Any:
    """The name of a value, which may be an object with it."""
    return entry.get("name") if isinstance(entry, dict) else entry


def _documents(
    paths: Sequence[Path], pictures: Sequence[Path], names: Mapping[int, str], *, negative: bool
) -> list[MaskDocument] | None:
    """The documents; None where pictures lie beside them that may be masks as well."""
    try:
        read = [read_mask_document(path, names, unannotated_negative=negative) for path in paths]
    except InvalidFeatures:
        if pictures:
            return None
        raise
    # Documents that name their images lie beside photos (Roboflow) or pictures of ids.
    own = all(image.image is not None or image.ids is not None for document in read for image in document.images)
    return None if pictures and not own else read


def _add_documents(
    index: _MaskIndex, documents: Sequence[MaskDocument], folder: Path, ids: Sequence[Path]
) -> list[str]:
    """Add the masks of all documents; what a user should know of them."""
    views, id_files = _document_views(documents, folder), _id_files(documents, folder, ids)
    own: dict[str, str] = {}  # view -> its file, of data sets
    for document, image in ((one, image) for one in documents for image in one.images):
        id_file = None if image.ids is None else _id_file(image.ids, document.path, id_files)
        if id_file is not None and image.image is None:
            name = tracked_view(id_file, document.path, folder, image.ids.name if image.ids else "")
        else:
            name = views[document.path, image.image]
        if image.file and own.setdefault(name, image.file) != image.file:
            got = f"{own[name]} and {image.file}, both of the view {name!r}"
            hint = "copies that were turned, cut or mirrored do not lie on their photo: export without augmentation"
            raise InvalidFeatures(str(document.path), expected="one image a photo", got=got, hint=hint)
        view = index.view(name, document.path)
        view.decided |= image.decided
        view.undecided |= image.undecided
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
        known = ", ".join(map(str, list(objects.phrases)[:6]))
        raise InvalidFeatures(str(path), expected=f"the ids of its JSON ({known}), and 0", got=f"the id {unknown[0]}")
    _add_ids(index, view, name, path, values, objects.phrases)


def _id_files(documents: Sequence[MaskDocument], folder: Path, files: Sequence[Path]) -> dict[str, list[Path]]:
    """Name without suffix -> files that may hold ids of a document: below the folder, or in ``mask_data`` beside."""
    beside = {document.path.parent.parent / MASK_DATA for document in documents if document.has_ids()}
    outside = [path for path in sorted(beside) if path.is_dir() and not path.is_relative_to(folder)]
    found: dict[str, list[Path]] = {}
    for path in [*files, *(file for one in outside for file in visible_files(one))]:
        if path.suffix.lower() in (*ARRAYS, PICTURE):
            found.setdefault(composed(path.stem), []).append(path)
    return found


def _id_file(objects: IdObjects, document: Path, files: Mapping[str, Sequence[Path]]) -> Path:
    """The file of a document's ids; of several of its name, the one that lies nearest."""
    stem = composed(PurePosixPath(objects.name.replace("\\", "/")).stem)
    if stem not in files:
        hint = f"give the folder that holds both, or keep {MASK_DATA} beside the folder of the JSON"
        expected = f"its ids in {stem}.npy, .npz or .png"
        raise InvalidFeatures(str(document), expected=expected, got="no such file", hint=hint)
    return min(files[stem], key=lambda path: sum(not path.is_relative_to(parent) for parent in document.parents))


def _document_views(documents: Sequence[MaskDocument], folder: Path) -> dict[tuple[Path, str | None], str]:
    """Document and image -> view.

    Images of data sets keep the folders of their relative paths. A document of one image is of the view that it is
    named after, unless it names another image.
    """
    views: dict[tuple[Path, str | None], str] = {}
    by_path: dict[tuple[Path, str], str] = {}
    for document, image in ((one, image) for one in documents for image in one.images):
        own, name = _view_of(document.path, folder), image.image
        if name is None:
            views[document.path, None] = own
            continue
        path = without_image_suffix(name)
        if image.listed and not _is_absolute(path):
            views[document.path, name] = path
        elif not image.listed and PurePosixPath(path).name == PurePosixPath(own).name:
            views[document.path, name] = own
        else:
            by_path[document.path, name] = name
    if by_path:
        known = views_of_images([*by_path.values()])
        views.update({key: known[name] for key, name in by_path.items()})
    return views


def _names_of(files: Sequence[Path]) -> str:
    return files[0].name if len(files) == 1 else f"{len(files)} files ({files[0].name}, ...)"


def _is_absolute(path: str) -> bool:
    return path.startswith("/") or path[1:3] == ":/"


def _document_warnings(documents: Sequence[MaskDocument], views: Mapping[tuple[Path, str | None], str]) -> list[str]:
    warnings = list[str]()
    for document in documents:
        listed = {views[document.path, one.image] for one in document.images if one.listed and one.image}
        come_to = {views[document.path, one.image] for one in document.images if one.annotated and one.listed}
        if missing := len(listed - come_to):
            warnings.append(
                f"{missing} of {len(listed)} images of {document.path.name} have no annotation and are left out; "
                "with --unannotated negative they show none of its phrases"
            )
    if boxes := [document for document in documents if document.boxes]:
        count, some = sum(document.boxes for document in boxes), _names_of([document.path for document in boxes])
        warnings.append(
            f"{count} annotations of {some} have a box or less and no mask: what lies in the boxes has no label; "
            "make masks of them, with SAM say"
        )
    beyond = {document.path: count for document in documents if (count := document.beyond())}
    if beyond:
        warnings.append(
            f"{sum(beyond.values())} polygons of {_names_of([*beyond])} reach beyond their images, and are cut off "
            "there: width and height must be those of the photos that were annotated"
        )
    several = Counter(view for (_, image), view in views.items() if image is not None)
    alone = {
        views[document.path, image.image]
        for document in documents
        for image in document.images
        if image.image is not None and not image.listed
    }
    for view in sorted(view for view in alone if several[view] > 1):
        warnings.append(f"{several[view]} files are of one image, {view!r}: their masks are put together")
    return warnings
