"""Masks that a text prompt made, as SAM 3 and Grounding DINO give them: regions whose vectors stand for phrases.

Phrase k of n has the k-th unit vector of n + 1 channels. What no phrase's mask covers has the last one: it was looked
at, and is none of them. So a lifted splat's feature holds the share of its light that each phrase's masks took, and
the cosine to a phrase is near 1 where nearly all of it lies in them. The vectors of the phrases go into the pack as a
table, and a lift of it is asked in these words without an encoder.

A folder holds, with sub-folders where views have some (``camA/000``), one of:

* binary PNGs, ``PHRASE/VIEW.png`` or, by ``folders="views"``, ``VIEW/PHRASE.png``; ``_`` stands for a space;
* JSON, ``VIEW.json`` with records (a list, or ``annotations``) of a phrase and ``segmentation`` as run lengths, or
  COCO's data set with ``images``, ``annotations`` and ``categories``, where SA-Co's images have a ``text_input``;
* label PNGs ``VIEW.png`` with the names of their values: in a file, or in the picture's text ``legend``, as
  ``splatlift segment --labels`` writes it.

Masks of one phrase in a view are put together. A view counts once it has a file or a record, if only of an empty
mask.
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import ViewFolder, files_below
from liftcore.features.mask_files import (
    binary_png,
    label_png,
    mask_of_runs,
    mask_records,
    read_mask_json,
    read_runs,
)
from liftcore.features.masks import layered
from liftcore.features.views import NO_LABEL, Regions
from liftcore.query.text.table import TableEncoder, plain
from liftcore.scene.views import without_image_suffix

PHRASE_KEYS = ("phrase", "prompt", "text", "label", "class_name", "category_name", "text_input")  # of a record
MOST_PHRASES = 4_096
LEGEND = "legend"  # the text of a label picture that names its values
LAYOUTS = "PHRASE/VIEW.png, VIEW.json with run lengths, or label pictures VIEW.png with --names"

Folders = Literal["phrases", "views"]


@dataclass
class _Masks:
    """Where the masks of each view are, by phrase; read when they are asked for."""

    phrases: dict[str, str] = field(default_factory=dict)  # as tables compare them -> as it was said first
    views: dict[str, list[tuple[str, Any]]] = field(default_factory=dict)  # (plain phrase, where), in their order
    files: dict[str, Path] = field(default_factory=dict)  # the first of each view

    def see(self, view: str, path: Path) -> None:
        """A view that was looked at."""
        self.views.setdefault(view, [])
        self.files.setdefault(view, path)

    def add(self, view: str, phrase: str, where: Any) -> None:
        """A mask of a view: a binary PNG, a picture with a value, or run lengths; None is an empty one."""
        if not (key := plain(phrase)):
            raise InvalidFeatures(f"view {view!r}", expected="a phrase for each mask", got="an empty one")
        self.phrases.setdefault(key, " ".join(phrase.replace("_", " ").split()))
        if where is not None:
            self.views[view].append((key, where))


@dataclass(frozen=True)
class Prompts:
    """Views of a folder of masks, and the table of their phrases."""

    views: ViewFolder[Regions]
    table: TableEncoder
    counts: Mapping[str, int]  # in how many views each phrase has a mask; one that has none is not in the table


def prompt_views(folder: Path, names: Path | None = None, folders: Folders = "phrases") -> Prompts:
    """The regions of a folder of masks by phrase (above); each view is read when it is asked for.

    Args:
        folder: the folder. folders: what its sub-folders of binary PNGs are named by.
        names: of label pictures, JSON from values to names, or a text whose k-th line names the value k.

    Raises:
        InvalidFeatures: there are no masks, kinds of them are mixed, a record has no phrase, or there are too many
            phrases. Reading a view: a file is malformed, or its masks have several sizes.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected="a folder of masks", got="no such folder")
    files = [path for path in files_below(folder) if names is None or not path.samefile(names)]
    documents = [path for path in files if path.suffix.lower() == ".json"]
    pictures = [path for path in files if path.suffix.lower() == ".png"]
    if bool(documents) == bool(pictures):
        got = f"{len(files)} other files" if not documents else f"{documents[0].name} and {pictures[0].name}"
        hint = "" if not documents else "name the file of names with --names, or keep kinds of masks apart"
        raise InvalidFeatures(str(folder), expected=f"one of {LAYOUTS}", got=got, hint=hint)
    found = _Masks()
    if documents:
        for path in documents:
            _add_json(found, path, _view(path, folder))
    elif names is not None or LEGEND in label_texts(pictures[0]):
        told = {} if names is None else _names(names)
        for path in pictures:
            _add_labels(found, path, _view(path, folder), told)
    else:
        for path in pictures:
            _add_binary(found, path, path.relative_to(folder), folders)
    seen_in = Counter(phrase for masks in found.views.values() for phrase in dict(masks))
    order = sorted(seen_in)
    if not 1 <= len(order) <= MOST_PHRASES:
        expected = f"1 to {MOST_PHRASES} phrases with masks"
        raise InvalidFeatures(str(folder), expected=expected, got=f"{len(order)} of {len(found.phrases)} phrases")
    rows = {phrase: row for row, phrase in enumerate(order)}
    vectors = np.eye(len(order) + 1, dtype=np.float16)
    views = ViewFolder(found.files, lambda view: _regions(view, found, rows, vectors), files)
    table = TableEncoder("phrases", [found.phrases[phrase] for phrase in order], vectors[:-1])
    return Prompts(views, table, {said: seen_in[phrase] for phrase, said in sorted(found.phrases.items())})


def label_texts(path: Path) -> dict[str, str]:
    """The texts of a label picture; none of what is no such picture."""
    try:
        return label_png(path)[1]
    except InvalidFeatures:
        return {}


def _regions(view: str, found: _Masks, rows: Mapping[str, int], vectors: np.ndarray) -> Regions:
    where = str(found.files[view])
    masks: dict[str, np.ndarray] = {}
    for phrase, mask in _read(found.views[view]):
        before = masks.get(phrase, mask)
        size = next(iter(masks.values()), mask).shape
        if mask.shape != size:
            got = f"{size[0]} x {size[1]} and {mask.shape[0]} x {mask.shape[1]}"
            raise InvalidFeatures(f"view {view!r}", expected="masks of one size", got=got, hint="those of one photo")
        masks[phrase] = before | mask
    if not masks:
        labels = np.zeros((1, 1, 1), np.int32)
    else:
        labels = layered(list(masks.values()), where)
        labels[0][(labels == NO_LABEL).all(axis=0)] = len(masks)
    return Regions(labels, vectors[[*(rows[phrase] for phrase in masks), len(rows)]], where=f"view {view!r}")


def _read(masks: Iterable[tuple[str, Any]]) -> Iterator[tuple[str, np.ndarray]]:
    opened: tuple[Path | None, np.ndarray] = None, np.empty(0)
    for phrase, where in masks:
        if isinstance(where, Path):
            yield phrase, binary_png(where)
        elif isinstance(where[0], Path):
            opened = opened if opened[0] == where[0] else (where[0], label_png(where[0])[0])
            yield phrase, opened[1] == where[1]
        else:
            yield phrase, mask_of_runs(*where)


def _view(path: Path, folder: Path) -> str:
    return without_image_suffix(path.relative_to(folder).with_suffix("").as_posix())


def _add_binary(found: _Masks, path: Path, inner: Path, folders: Folders) -> None:
    parts = PurePosixPath(inner.with_suffix("").as_posix()).parts
    if len(parts) < 2:
        raise InvalidFeatures(str(path), expected=LAYOUTS, got="a picture in no phrase's folder and without names")
    phrase, view = (parts[0], parts[1:]) if folders == "phrases" else (parts[-1], parts[:-1])
    name = without_image_suffix("/".join(view))
    found.see(name, path)
    found.add(name, phrase, path if binary_png(path).any() else None)


def _add_labels(found: _Masks, path: Path, view: str, names: Mapping[int, str]) -> None:
    values, texts = label_png(path)
    named = names or _numbered(_parsed(texts.get(LEGEND, "null")), f"{path} legend")
    found.see(view, path)
    for value in np.unique(values[values != 0]).tolist():
        if value not in named:
            expected = f"a name for each value but 0 ({', '.join(map(str, list(named)[:6]))})"
            raise InvalidFeatures(str(path), expected=expected, got=f"the value {value}")
        found.add(view, named[value], (path, value))


def _names(path: Path) -> dict[int, str]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidFeatures("--names", expected="a file of names", got=str(error)[:120]) from None
    if path.suffix.lower() == ".json":
        return _numbered(_parsed(text), str(path))
    return {value: line.strip() for value, line in enumerate(text.splitlines(), start=1) if line.strip()}


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _numbered(told: Any, where: str) -> dict[int, str]:
    """Names by their values, of JSON from values to names or of a list, whose first names the value 1."""
    if isinstance(told, list):
        told = dict(enumerate(told, start=1))
    try:
        named = {int(value): name for value, name in told.items()}
    except (AttributeError, TypeError, ValueError):
        named = {}
    if not named or not all(isinstance(name, str) and name.strip() for name in named.values()):
        raise InvalidFeatures(where, expected='JSON of values and names, {"1": "red mug"}', got="none")
    return named


def _add_json(found: _Masks, path: Path, view: str) -> None:
    content = read_mask_json(path)
    images, categories = _by_id(content, "images"), _by_id(content, "categories")
    views = {number: _image_view(image, path) for number, image in images.items()} or {None: view}
    for name in views.values():
        found.see(name, path)
    for number, record in enumerate(mask_records(content, path)):
        where = f"{path} mask {number}"
        if not isinstance(record, dict):
            raise InvalidFeatures(where, expected="a mask with a phrase", got=type(record).__name__)
        image = _id(record, "image_id") if images else None
        if image not in views:
            raise InvalidFeatures(where, expected="an image_id of the file", got=repr(image)[:80])
        size, lengths = read_runs(record.get("segmentation"), where)
        told = images.get(image, {}).get("text_input"), categories.get(_id(record, "category_id"), {}).get("name")
        said = next((said for said in (*map(record.get, PHRASE_KEYS), *told) if isinstance(said, str)), None)
        if said is None:
            expected, hint = (
                f"a phrase ({', '.join(PHRASE_KEYS[:5])} or a category)",
                "'splatlift pack masks' needs none",
            )
            raise InvalidFeatures(where, expected=expected, got="none", hint=hint)
        found.add(views[image], said, (size, lengths) if lengths[1::2].any() else None)


def _by_id(content: Any, key: str) -> dict[Any, dict[str, Any]]:
    listed = content.get(key) if isinstance(content, dict) else None
    entries = [entry for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    return {number: entry for entry in entries if (number := _id(entry, "id")) is not None}


def _id(entry: Mapping[str, Any], key: str) -> int | str | None:
    number = entry.get(key)
    return number if isinstance(number, int | str) else None


def _image_view(image: Mapping[str, Any], path: Path) -> str:
    if not isinstance(image.get("file_name"), str):
        raise InvalidFeatures(f"{path} images", expected="a file_name of each", got="none")
    return without_image_suffix(image["file_name"])
