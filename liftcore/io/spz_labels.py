"""Labels in an ``.spz`` of version 4, as an extension that other readers skip (docs/formats.md specifies it).

The payload is the length of a JSON text (u32), that text, and a zstd stream a column. The text has ``columns``, each
with its ``name``, ``type`` (i4 or f4) and the ``bytes`` of its stream, in their order, and all of the document.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from liftcore.io.labels import COLUMN, FORMAT, IDS, MAX_COLUMNS, Labels, id_column
from liftcore.io.ply import MODEL

EXTENSION = 0x51F70001  # vendor 0x51F7, its first
TYPES = ("i4", "f4")


def label_record(stored: Mapping[str, np.ndarray], document: Mapping[str, Any] | None) -> bytes:
    """Encode the extension's record of columns [P] (`liftcore.io.labels.stored_columns`) and their document."""
    import zstandard

    columns, streams = [], []
    for name, column in stored.items():
        code = f"{column.dtype.kind}4"
        streams.append(zstandard.ZstdCompressor().compress(column.astype(f"<{code}").tobytes()))
        columns.append({"name": name, "type": code, "bytes": len(streams[-1])})
    text = json.dumps({"format": FORMAT, **(document or {}), "columns": columns}, ensure_ascii=False).encode()
    payload = struct.pack("<I", len(text)) + text + b"".join(streams)
    return struct.pack("<II", EXTENSION, len(payload)) + payload


def read_label_record(extensions: bytes, count: int) -> Labels | None:
    """Return the labels of P splats among the records of a file; None if none is valid."""
    for kind, payload in records(extensions):
        if kind == EXTENSION:
            try:
                return _read(payload, count)
            except (ValueError, RecursionError, struct.error):
                return None
    return None


def records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and payload of each extension; of a truncated one the rest."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        yield kind, extensions[at + 8 : at + 8 + size]
        at += 8 + size


def _read(payload: bytes, count: int) -> Labels:
    """Decode a payload, or raise ValueError if it is not of the format."""
    import zstandard

    (length,) = struct.unpack_from("<I", payload)
    document = json.loads(payload[4 : 4 + length])
    at, columns = 4 + length, {}
    entries = document.get("columns") if isinstance(document, dict) else None
    if not isinstance(entries, list) or len(entries) > MAX_COLUMNS or document.get("format") != FORMAT:
        raise ValueError("no document of labels")
    for item in entries:
        entry = item if isinstance(item, dict) else {}
        name, code, size = (entry.get(key) for key in ("name", "type", "bytes"))
        if not isinstance(name, str) or code not in TYPES or type(size) is not int or size < 0:
            raise ValueError("no column")
        stream, at = payload[at : at + size], at + size
        try:
            if zstandard.frame_content_size(stream) not in (-1, 4 * count):
                raise ValueError("a column of another size")
            values = zstandard.ZstdDecompressor().decompress(stream, max_output_size=4 * count)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
        if len(values) != 4 * count:
            raise ValueError("a column of another size")
        if COLUMN.fullmatch(name) and not MODEL.fullmatch(name):
            entry = np.frombuffer(values, f"<{code}")
            columns[name] = id_column(entry) if name in IDS else entry.astype(code)
    return Labels(columns, document | {"columns": list(columns)})
