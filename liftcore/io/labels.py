"""Labels of splats in files: columns of ids and scores, and a document that describes the ids.

The columns are ``class_id``, ``instance_id`` and ``node_id``, from 1 with 0 for none, ``score`` and ``confidence``; a
file may have others. They are `Splats.extras` of splats that are read or written. The document has ``classes``,
``instances`` and ``nodes``, each a list of objects whose ``class_id``, ``instance_id`` or ``node_id`` is that of the
columns, with their names, scores, colours, boxes and queries (docs/formats.md). ``node_id`` is the smallest node that
has the splat; the splat belongs to all nodes of that node's ``path``.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.scene.kernel import NORMALS

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

FORMAT = "splatlift-labels/1"
COLUMN = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,63}")  # a name that readers of PLY take
IDS = ("instance_id", "class_id", "node_id")  # columns of whole numbers, 0 for none
MAX_COLUMNS = 256  # of a file that is not a PLY
KINDS = ("instances", "classes", "nodes")  # of the document, by the columns above


@dataclass(frozen=True)
class Labels:
    """Columns of splats, and the document that describes their ids."""

    columns: dict[str, np.ndarray]  # name -> [P] i32 or f32
    document: dict[str, Any]

    def subset(self, rows: np.ndarray) -> Labels:
        """Return the labels of the rows of a mask [P], with the document's entries of these alone."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        ids = {name: set(np.unique(columns[name]).tolist()) for name in IDS if name in columns}
        if "node_id" in ids:  # a node stays if any of its parts does
            paths = (row["path"] for row in self.document["nodes"] if row["node_id"] in ids["node_id"])
            ids["node_id"] = {number for path in paths for number in path}
        document = self.document | {"splats": int(np.count_nonzero(rows))}
        for name, kind in zip(IDS, KINDS, strict=True):
            if name in ids:
                document[kind] = [row for row in self.document.get(kind, []) if row.get(name) in ids[name]]
        return Labels(columns, document)


def stored_columns(splats: Splats) -> dict[str, np.ndarray]:
    """Return the extras of splats without normals, each [P] i32 or f32, for formats with columns of 32 bits."""
    columns: dict[str, np.ndarray] = {}
    for name, column in splats.extras.items():
        values = column.cpu().numpy()
        if name in NORMALS:
            continue
        if name in IDS:
            in_range = (values >= 1) & (values <= np.iinfo(np.int32).max)
            values = np.where(in_range, values, 0).astype(np.int32)  # all else is none
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
    """Return the document as a JSON file."""
    return json.dumps(labels.document, ensure_ascii=False, indent=1).encode() + b"\n"
