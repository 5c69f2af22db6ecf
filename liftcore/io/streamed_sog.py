"""PlayCanvas's streamed SOG: ``lod-meta.json`` and SOGs beside it, whose finest splats are read as one scene.

A leaf of the document's tree has for each level of detail a range of rows of one of its files; 0 is the finest. Of
each leaf the finest level that it has is read. Rows come file by file in the order of ``filenames``, and within one
as they lie there. What surrounds the scene (``environment``) is left out, with a warning.
"""

from __future__ import annotations

import json
import zipfile
from collections import defaultdict
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.files import BROKEN_ZIP, open_regular, open_zip
from liftcore.io.quantised import MOST_GROWTH, Fields, joined_fields
from liftcore.io.sog import HINT, META, decode_sog, is_bundled, read_in_archive, read_sog, sog_files

LOD_META = "lod-meta.json"
MAX_DOCUMENT_BYTES = 64 << 20


def read_streamed_sog(path: Path, *, colour: bool = True) -> Fields:
    """Read the fields of the finest splats of a streamed SOG: its ``lod-meta.json``, folder, or a zip of that.

    Raises:
        InvalidSplats: a file is missing or malformed, lies outside the folder, or two leaves have the same row.
    """
    try:
        if not is_bundled(path):
            document = _document_of(path)
            return _join_chunks(document, partial(_chunk_in_folder, _meta_of(path).parent, colour=colour), path)
        with open_zip(path) as archive:
            prefix = streamed_folder(archive.namelist()) or ""
            limit = min(MAX_DOCUMENT_BYTES, MOST_GROWTH * path.stat().st_size)
            document = json.loads(read_in_archive(archive, prefix, LOD_META, limit) or b"")
            return _join_chunks(document, partial(_chunk_in_archive, archive, prefix, path, colour=colour), path)
    except (*BROKEN_ZIP, RecursionError) as error:
        raise _error(path, LOD_META, f"one that does not open ({str(error)[:120]})") from None


def is_streamed_document(document: Any) -> bool:
    """Return True if a JSON document is a ``lod-meta.json``."""
    return isinstance(document, dict) and document.keys() >= {"tree", "filenames"}


def streamed_folder(names: list[str]) -> str | None:
    """Return the folder, with a slash if any, in which a zip of these names holds a streamed SOG; None if in none."""
    matches = [name for name in names if PurePosixPath(name).name == LOD_META and "__MACOSX/" not in name]
    return min(matches).removesuffix(LOD_META) if matches else None


def streamed_files(path: Path) -> list[Path]:
    """Return the files that the finest splats of a folder or ``lod-meta.json`` are read from, sorted."""
    folder = _meta_of(path).parent
    try:
        names = [name for name, _ in _finest_ranges(_document_of(path), path)]
    except InvalidSplats:
        names = []
    chunks = [folder / name for name in names if (folder / name).is_file()]
    parts = [file for chunk in chunks for file in ([chunk] if is_bundled(chunk) else sog_files(chunk))]
    return sorted([_meta_of(path), *parts])


def _meta_of(path: Path) -> Path:
    return path / LOD_META if path.is_dir() else path


def _document_of(path: Path) -> Any:
    try:
        with open_regular(_meta_of(path)) as handle:
            return json.loads(handle.read(MAX_DOCUMENT_BYTES))
    except (ValueError, RecursionError) as error:
        raise _error(path, f"{LOD_META} as JSON", str(error)[:120]) from None


def _join_chunks(document: Any, fields_of: partial[Fields], path: Path) -> Fields:
    parts = []
    for name, ranges in _finest_ranges(document, path):
        fields = fields_of(name)
        count, last = len(fields["means"]), ranges[-1][1]
        if last > count:
            raise _error(path, f"rows within the {count} of {name!r}", f"rows to {last}")
        rows = np.concatenate([np.arange(first, end) for first, end in ranges])
        arrays = {key: values[rows] for key, values in fields.items() if isinstance(values, np.ndarray)}
        parts.append(fields | arrays)
    fields = joined_fields(parts)
    if document.get("environment") is not None:
        text = f"the environment of {LOD_META} is not read: give {document['environment']!r} to read it"[:200]
        fields["warnings"] = (*fields["warnings"], text)
    return fields


def _finest_ranges(document: Any, path: Path) -> list[tuple[str, list[tuple[int, int]]]]:
    """Return the names of files, in their order, and the ranges of rows of each that are the finest, sorted.

    Raises:
        InvalidSplats: the document is malformed, names a file outside its folder or one twice, or ranges overlap.
    """
    if not is_streamed_document(document) or not isinstance(document["filenames"], list):
        raise _error(path, "a 'tree' and 'filenames'", "others")
    names, ranges, nodes = document["filenames"], defaultdict(list), [document["tree"]]
    while nodes:
        node = nodes.pop()
        if not isinstance(node, dict):
            raise _error(path, "nodes that are objects", repr(node)[:60])
        children, levels = node.get("children", []), node.get("lods", {})
        if not isinstance(children, list) or not isinstance(levels, dict):
            raise _error(path, "'children' as a list and 'lods' as an object", repr(node)[:60])
        nodes += children
        if levels:
            file, first, count = _range_of(_finest(levels, path), len(names), path)
            ranges[file] += [(first, first + count)] if count else []
    file_ranges = [(names[file], sorted(ranges[file])) for file in sorted(ranges) if ranges[file]]
    used_names = [name for name, _ in file_ranges]
    if (
        not file_ranges
        or not all(isinstance(name, str) and _is_below(name) for name in used_names)
        or len({*used_names}) < len(used_names)
    ):
        expected = "names of SOGs in the folder, each once"
        raise _error(path, expected, repr(used_names)[:80] if file_ranges else "none that a leaf has")
    for name, intervals in file_ranges:
        if any(following[0] < before[1] for before, following in pairwise(intervals)):
            raise _error(path, "leaves with rows of their own", f"two with the same of {name!r}")
    return file_ranges


def _finest(levels: dict[str, Any], path: Path) -> Any:
    if not all(level.isdecimal() and level.isascii() and len(level) < 4 for level in levels):
        raise _error(path, "levels of detail by their numbers", repr(list(levels))[:60])
    return levels[min(levels, key=int)]


def _range_of(level: Any, files: int, path: Path) -> tuple[int, int, int]:
    members = level if isinstance(level, dict) else {}
    file, offset, count = (_whole_number(members.get(key)) for key in ("file", "offset", "count"))
    if file < 0 or offset < 0 or count < 0:
        raise _error(path, "file, offset and count of a level", repr(level)[:60])
    if file >= files:
        raise _error(path, f"one of {files} files", f"the file {file}")
    return file, offset, count


def _whole_number(value: Any) -> int:
    """Return the number, or -1 for what is none of 32 bits."""
    return value if type(value) is int and 0 <= value < 1 << 32 else -1


def _is_below(name: str) -> bool:
    return (
        (PurePosixPath(name).name == META or name.endswith(".sog"))
        and str(PurePosixPath(name)) == name  # one name a file
        and not name.startswith("/")
        and ".." not in PurePosixPath(name).parts
        and not {"\\", "\0", ":"} & {*name}
    )


def _chunk_in_folder(folder: Path, name: str, *, colour: bool) -> Fields:
    if not (folder / name).is_file():
        raise _error(folder / LOD_META, f"{name!r} beside it", "none")
    return read_sog(folder / name, colour=colour)


def _chunk_in_archive(archive: zipfile.ZipFile, prefix: str, path: Path, name: str, *, colour: bool) -> Fields:
    inside = (prefix + name).removesuffix(META)
    size = sum(info.compress_size for info in archive.infolist() if info.filename.rpartition("/")[0] == inside[:-1])
    return decode_sog(partial(read_in_archive, archive, inside), path / name, size, colour=colour)


def _error(path: Path, expected: str, got: str) -> InvalidSplats:
    return InvalidSplats(str(path), expected=expected, got=got, hint=HINT)
