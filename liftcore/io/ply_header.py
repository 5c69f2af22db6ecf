"""The header of a splat PLY, read under limits before anything trusts its numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from liftcore.errors import InvalidSplats
from liftcore.io.files import CONVERT, foreign_format

MAX_HEADER_BYTES = 256 * 1024
MAX_HEADER_LINES = 4096

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
_OTHER_FORMATS = {"ascii", "binary_big_endian"}
_EXPORT = "export the splats again as binary little-endian PLY"
_REWRITE = (
    "rewrite it with Python: from plyfile import PlyData; p = PlyData.read('IN.ply'); p.text = False; "
    "p.byte_order = '<'; p.write('OUT.ply')"
)
_SPLAT_PROPERTIES = ("opacity", "scale_0", "rot_0", "f_dc_0", "sh0_0", "packed_position")  # one at least


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
    """A header that fits its file: a vertex element of scalar columns before any other, little-endian."""

    lines: tuple[str, ...]  # verbatim, with end_header, without the line feeds and what describes other elements
    count: int  # rows
    properties: tuple[PlyProperty, ...]
    data_offset: int  # bytes before the first row
    after: int | None = 0  # bytes behind the last row, of other elements; None when their lists make it unknown

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
    """Read and check the header of a splat PLY, at most 256 KiB of the file.

    Raises:
        InvalidSplats: the file cannot be opened, is not a binary little-endian PLY that begins with a vertex element
            of scalar properties, or has another size than the header says.
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
    expected = header.count * header.stride + (header.after or 0)
    if rows < expected or (header.after is not None and rows > expected):
        if rows < expected:
            hint = "the file is truncated: copy or export it again"
        else:
            hint = "the file has bytes that its header does not describe: export it again"
        raise InvalidSplats(
            str(path),
            expected=f"{header.count} rows of {header.stride} bytes"
            + (f" and {header.after} bytes of other elements" if header.after else "")
            + f" = {expected} bytes after the header",
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
        foreign = foreign_format(head, Path(source).suffix)
        got, hint = foreign or (_first_bytes(head), f"{_EXPORT}; if it is a .splat or a .ksplat, {CONVERT}")
        raise InvalidSplats(source, expected="a PLY file (first line 'ply')", got=got, hint=hint)
    end = _END.search(head)
    if end is None:
        limit = f"'end_header' within the first {MAX_HEADER_BYTES} bytes"
        raise InvalidSplats(source, expected=limit, got=f"none in {len(head)} bytes", hint=_EXPORT)
    text = head[: end.end() - 1]
    if not text.isascii():
        hint = "take the comments with other characters out of it"
        raise InvalidSplats(source, expected="an ASCII header", got="other characters in it", hint=hint)
    lines = tuple(text.decode("ascii").split("\n"))
    if len(lines) > MAX_HEADER_LINES:
        limit, hint = f"at most {MAX_HEADER_LINES} header lines", "leave out properties that are no splat's"
        raise InvalidSplats(source, expected=limit, got=str(len(lines)), hint=hint)
    _refuse_clouds(lines, source)
    found = _HeaderLines(source)
    found.walk(lines[1:-1])
    own = (*lines[: found.own_lines + 1], lines[-1])
    return PlyHeader(own, found.count or 0, tuple(found.properties.values()), end.end(), found.after)


def _refuse_clouds(lines: tuple[str, ...], source: str) -> None:
    """Point clouds and meshes: what is wrong with them is not how they are written."""
    words = [line.split() for line in lines]
    names = {line[-1] for line in words if line[:1] == ["property"]}
    if not names.issuperset("xyz") or names.intersection(_SPLAT_PROPERTIES):
        return
    is_mesh = any(line[:2] == ["element", "face"] for line in words)
    hint = "give the trained splats; the 3DGS trainers keep them in point_cloud/iteration_N/point_cloud.ply"
    if any(name.startswith("scalar_") for name in names):
        hint = "CloudCompare renames properties (scalar_opacity): give the file that it was opened from"
    raise InvalidSplats(
        source,
        expected="splats (properties such as 'opacity', 'scale_0', 'rot_0')",
        got=f"a {'mesh' if is_mesh else 'point cloud'} without any of them",
        hint=hint,
    )


def _first_bytes(head: bytes) -> str:
    return f"a file that begins with {head[:8]!r}" if head else "an empty file"


class _HeaderLines:
    """The lines between ``ply`` and ``end_header``, one method a keyword."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.has_format = False
        self.count: int | None = None
        self.properties: dict[str, PlyProperty] = {}
        self.own_lines = 0  # up to the elements behind the vertices
        self.after: int | None = 0
        self._other = 0  # rows of the element behind the vertices that is being read
        self._is_behind = False

    def walk(self, lines: tuple[str, ...]) -> None:
        keywords = {"format": self._format, "element": self._element, "property": self._property}
        for line in lines:
            words = line.split()
            if words and words[0] not in ("comment", "obj_info"):
                if words[0] not in keywords:
                    raise self._refuse("format, element, property or comment lines", f"{line.strip()[:60]!r}")
                keywords[words[0]](words)
            self.own_lines += not self._is_behind
        if self.count is None or not self.properties:
            raise self._refuse("an element 'vertex' with properties", "a header without one")

    def _format(self, words: list[str]) -> None:
        if self.has_format or words[2:] != _FORMAT[2:] or words[1] not in _OTHER_FORMATS | {_FORMAT[1]}:
            raise self._refuse(f"{' '.join(_FORMAT)!r}, once", repr(" ".join(words)[:60]))
        if words[1] in _OTHER_FORMATS:
            raise self._refuse(repr(" ".join(_FORMAT)), repr(" ".join(words)), _REWRITE)
        self.has_format = True

    def _element(self, words: list[str]) -> None:
        if not self.has_format:
            raise self._refuse("the format before the elements", repr(" ".join(words)[:60]))
        if len(words) != 3 or not _COUNT.fullmatch(words[2]):
            raise self._refuse("the name of an element and a count of zero or more", repr(" ".join(words)[:60]))
        if self.count is not None:
            self._is_behind, self._other = True, int(words[2])
        elif words[1] == "vertex":
            self.count = int(words[2])
        elif words[1] == "chunk":
            raise self._refuse("plain splats", "SuperSplat's compressed PLY", CONVERT)
        else:
            raise self._refuse("'vertex' as the first element", repr(" ".join(words)[:60]))

    def _property(self, words: list[str]) -> None:
        if self.count is None:
            raise self._refuse("'element vertex' before its properties", repr(" ".join(words)[:60]))
        is_list = len(words) == 5 and words[1] == "list" and self._is_behind
        if not is_list and (len(words) != 3 or words[1] not in SCALAR_TYPES):
            raise self._refuse("scalar properties ('property float x')", repr(" ".join(words)[:60]))
        if self._is_behind:
            self._pass_over(None if is_list else int(SCALAR_TYPES[words[1]][1:]))
            return
        name = words[2]
        if name in self.properties:
            raise self._refuse("each property once", f"{name!r} twice")
        self.properties[name] = PlyProperty(name, SCALAR_TYPES[words[1]])

    def _pass_over(self, width: int | None) -> None:
        """A column of an element that is not read, of so many bytes a row: None for lists."""
        if width is not None and self.after is not None:
            self.after += self._other * width
        elif self._other:
            self.after = None

    def _refuse(self, expected: str, got: str, hint: str = _EXPORT) -> InvalidSplats:
        return InvalidSplats(f"{self.source} header", expected=expected, got=got, hint=hint)
