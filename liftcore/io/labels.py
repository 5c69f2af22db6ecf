"""What every splat is, as files keep it: a number or two a splat, and a document of what these mean.

The columns of a splat are ``class_id``, ``instance_id`` and ``node_id``, from 1 with 0 for none, ``score`` and
``confidence``; a file may have others. They are `Splats.extras` of splats that are read or written. The document has
``classes``, ``instances`` and ``nodes``, each a list of objects whose ``class_id``, ``instance_id`` or ``node_id`` is
that of the columns, with their names, scores, colours, boxes and questions (docs/formats.md). A splat's node is the
smallest; it is of all others of that node's ``path``, too.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.files import open_regular
from liftcore.scene.kernel import NORMALS

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

FORMAT = "splatlift-labels/1"
COLUMN = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,63}")  # a name that readers of PLY take
IDS = ("instance_id", "class_id", "node_id")  # columns of whole numbers, 0 for none
MAX_COLUMNS = 256  # of a file that is not a PLY
MAX_DOCUMENT_BYTES = 64 << 20
KINDS = ("instances", "classes", "nodes")  # of the document, by the columns above


@dataclass(frozen=True)
class Labels:
    """Columns of splats, and the document that says what their numbers mean."""

    columns: dict[str, np.ndarray]  # name -> [P] i32 or f32
    document: dict[str, Any]

    def chosen(self, rows: np.ndarray) -> Labels:
        """The labels of the rows that a mask [P] chooses, with what the document says of those alone."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        left = {name: set(np.unique(columns[name]).tolist()) for name in IDS if name in columns}
        if "node_id" in left:  # a node is left with any of its parts
            paths = (one["path"] for one in self.document["nodes"] if one["node_id"] in left["node_id"])
            left["node_id"] = {number for path in paths for number in path}
        document = self.document | {"splats": int(np.count_nonzero(rows))}
        for name, kind in zip(IDS, KINDS, strict=True):
            if name in left:
                document[kind] = [one for one in self.document.get(kind, []) if one.get(name) in left[name]]
        return Labels(columns, document)


def id_column(values: np.ndarray) -> np.ndarray:
    """[P] i32, ids [P] of any type; what is no number from 1 to 2^31 - 1 is 0, none."""
    return np.where((values >= 1) & (values <= np.iinfo(np.int32).max), values, 0).astype(np.int32)


def stored_columns(splats: Splats) -> dict[str, np.ndarray]:
    """The extras of splats without normals, each [P] i32 or f32, as formats with columns of 32 bits hold them.

    Raises:
        InvalidSplats: whole numbers need more bits, or the columns are too many.
    """
    columns: dict[str, np.ndarray] = {}
    for name, column in splats.extras.items():
        values = column.cpu().numpy()
        if name in NORMALS:
            continue
        if name in IDS:
            values = id_column(values)
        elif values.dtype.kind in "iu" and not -(2**31) <= int(values.min()) <= int(values.max()) < 2**31:
            got = f"{values.min()}..{values.max()}"
            raise InvalidSplats(f"columns[{name!r}]", expected="whole numbers of 32 bits", got=got)
        with np.errstate(over="ignore"):
            columns[name] = values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
    if len(columns) > MAX_COLUMNS:
        hint = "write a PLY, which has any number of them"
        raise InvalidSplats("columns", expected=f"at most {MAX_COLUMNS}", got=str(len(columns)), hint=hint)
    return columns


def document_bytes(labels: Labels) -> bytes:
    """The document as a JSON file."""
    return json.dumps(labels.document, ensure_ascii=False, indent=1).encode() + b"\n"


# What JSON leaves as it is, and readers of lines take for the end of one
LINE_ENDS = {ord(one): f"\\u{ord(one):04x}" for one in "\x85\u2028\u2029"}


def document_lines(labels: Labels) -> bytes:
    """The instances, or the nodes where there are any, as JSON Lines: a line each, with all that is said of it."""
    names = ("format", "made_by", "frame", "world", "unit")
    whole = {name: labels.document[name] for name in names if name in labels.document}
    listed = labels.document.get("nodes") or labels.document.get("instances", [])
    rows = (json.dumps(one | whole, ensure_ascii=False).translate(LINE_ENDS) for one in listed)
    return "".join(f"{row}\n" for row in rows).encode()


def rows_by_id(document: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    """The rows of one of KINDS where their numbers are their places; an empty one where is none."""
    name = IDS[KINDS.index(kind)]
    rows = {one[name]: one for one in document.get(kind, [])}
    return [rows.get(place, {}) for place in range(max(rows, default=0) + 1)]


def read_document(path: Path) -> dict[str, Any]:
    """The document of a JSON file; empty where there is none of its format, or no such file."""
    try:
        with open_regular(path) as handle:
            document = json.loads(handle.read(MAX_DOCUMENT_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) and document.get("format") == FORMAT else {}
