"""The header of a splat PLY, read under limits before anything trusts its numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.errors import InvalidSplats

if TYPE_CHECKING:
    from pathlib import Path

MAX_HEADER_BYTES = 64 * 1024
MAX_HEADER_LINES = 1024

# Both spellings of the eight scalar types of PLY 1.0, and their NumPy names.
SCALAR_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}

_END = re.compile(rb"(?:^|\n)end_header(\r?\n)")
_COUNT = re.compile(r"[0-9]{1,18}")
_FORMAT = ["format", "binary_little_endian", "1.0"]
_EXPORT = "export the splats again as binary little-endian PLY"


@dataclass(frozen=True)
class PlyProperty:
    """One scalar column of the vertex element."""

    name: str
    code: str  # NumPy's name of the type, without byte order: "f4"

    @property
    def width(self) -> int:
        """Bytes a row."""
        return int(self.code[1:])


@dataclass(frozen=True)
class PlyHeader:
    """A header that fits its file: one vertex element of scalar columns, little-endian."""

    lines: tuple[str, ...]  # verbatim, with end_header, without the line feeds
    count: int  # rows
    properties: tuple[PlyProperty, ...]
    data_offset: int  # bytes before the first row

    @property
    def stride(self) -> int:
        """Bytes a row."""
        return sum(column.width for column in self.properties)

    def lines_for(self, count: int) -> tuple[str, ...]:
        """The lines of a file with ``count`` rows of these columns; all but that number stays as it is."""
        if count == self.count:
            return self.lines
        end = "\r" if self.lines[0].endswith("\r") else ""
        element = f"element vertex {count}{end}"
        return tuple(element if line.split()[:1] == ["element"] else line for line in self.lines)


def read_header(path: Path) -> PlyHeader:
    """Read and check the header of a splat PLY, at most 64 KiB of the file.

    Raises:
        InvalidSplats: the file cannot be opened, is not a binary little-endian PLY with one vertex element of
            scalar properties, or has another size than the header says.
    """
    try:
        with path.open("rb") as handle:
            head = handle.read(MAX_HEADER_BYTES)
            size = handle.seek(0, 2)
    except OSError as error:
        raise InvalidSplats(
            str(path), expected="a splat file", got=f"one that does not open ({error.strerror})"
        ) from None
    header = parse_header(head, str(path))
    rows = size - header.data_offset
    expected = header.count * header.stride
    if rows != expected:
        if rows < expected:
            hint = "the file is truncated: copy or export it again"
        else:
            hint = "the file has bytes that its header does not describe: export it again"
        raise InvalidSplats(
            str(path),
            expected=f"{header.count} rows of {header.stride} bytes = {expected} bytes after the header",
            got=f"{rows} bytes",
            hint=hint,
        )
    return header


def parse_header(head: bytes, source: str) -> PlyHeader:
    """Parse the first bytes of a PLY; ``source`` names the file in errors.

    Raises:
        InvalidSplats: the bytes are not the header of a splat PLY.
    """
    if head[:4] not in (b"ply\n", b"ply\r"):
        raise InvalidSplats(source, expected="a PLY file (first line 'ply')", got=_first_bytes(head), hint=_EXPORT)
    end = _END.search(head)
    if end is None:
        limit = f"'end_header' within the first {MAX_HEADER_BYTES} bytes"
        raise InvalidSplats(source, expected=limit, got=f"none in {len(head)} bytes", hint=_EXPORT)
    text = head[: end.end() - 1]
    if not text.isascii():
        raise InvalidSplats(source, expected="an ASCII header", got="other characters in it", hint=_EXPORT)
    lines = tuple(text.decode("ascii").split("\n"))
    if len(lines) > MAX_HEADER_LINES:
        limit = f"at most {MAX_HEADER_LINES} header lines"
        raise InvalidSplats(source, expected=limit, got=str(len(lines)), hint=_EXPORT)
    count, properties = _HeaderLines(source).walk(lines[1:-1])
    return PlyHeader(lines, count, properties, data_offset=end.end())


def _first_bytes(head: bytes) -> str:
    return f"a file that begins with {head[:8]!r}" if head else "an empty file"


class _HeaderLines:
    """The lines between ``ply`` and ``end_header``, one method a keyword."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.has_format = False
        self.count: int | None = None
        self.properties: dict[str, PlyProperty] = {}

    def walk(self, lines: tuple[str, ...]) -> tuple[int, tuple[PlyProperty, ...]]:
        keywords = {"format": self._format, "element": self._element, "property": self._property}
        for line in lines:
            words = line.split()
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] not in keywords:
                raise self._refuse("format, element, property or comment lines", f"{line.strip()[:60]!r}")
            keywords[words[0]](words)
        if self.count is None or not self.properties:
            raise self._refuse("an element 'vertex' with properties", "a header without one")
        return self.count, tuple(self.properties.values())

    def _format(self, words: list[str]) -> None:
        if words != _FORMAT or self.has_format:
            raise self._refuse(f"{' '.join(_FORMAT)!r}, once", repr(" ".join(words)[:60]))
        self.has_format = True

    def _element(self, words: list[str]) -> None:
        if not self.has_format:
            raise self._refuse("the format before the elements", repr(" ".join(words)[:60]))
        if self.count is not None or len(words) != 3 or words[1] != "vertex":
            hint = "compressed splats and meshes have other elements: export plain splats"
            raise self._refuse("'vertex' as the only element", repr(" ".join(words)[:60]), hint)
        if not _COUNT.fullmatch(words[2]):
            raise self._refuse("a count of splats of zero or more", repr(words[2][:40]))
        self.count = int(words[2])

    def _property(self, words: list[str]) -> None:
        if self.count is None:
            raise self._refuse("'element vertex' before its properties", repr(" ".join(words)[:60]))
        if len(words) != 3 or words[1] not in SCALAR_TYPES:
            raise self._refuse("scalar properties ('property float x')", repr(" ".join(words)[:60]))
        name = words[2]
        if name in self.properties:
            raise self._refuse("each property once", f"{name!r} twice")
        self.properties[name] = PlyProperty(name, SCALAR_TYPES[words[1]])

    def _refuse(self, expected: str, got: str, hint: str = _EXPORT) -> InvalidSplats:
        return InvalidSplats(f"{self.source} header", expected=expected, got=got, hint=hint)
