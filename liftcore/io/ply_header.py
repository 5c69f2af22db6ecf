"""Headers of splat PLY files: which column is which number of the model, and what a header may say.

Headers are read under limits, and what they say must fit the file's size, before anything trusts their numbers.

One table serves reading and writing, for every dialect: Inria, gsplat (no normals), SAGA and LaGa (``mask``),
2DGS (two scales) and DBS (``sh0_*``, ``shN_*``, ``sb_params_*``, ``beta``). Colour coefficients and lobes are
stored channel-major: all of red, then green, then blue.
"""

import io
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.files import CONVERT, foreign_format
from liftcore.scene.kernel import Kernel

MAX_SH_DEGREE = 4
LOBE_CHANNELS = 6  # of a spherical beta lobe: r g b theta phi beta
NORMALS = ("nx", "ny", "nz")
MAX_HEADER_BYTES = 256 * 1024
MAX_HEADER_LINES = 4096
SPLAT_PROPERTIES = ("opacity", "scale_0", "rot_0", "f_dc_0", "sh0_0", "packed_position")  # one at least
EXPORT = "export the splats again as binary little-endian PLY"
REWRITE = (
    "rewrite it with Python: from plyfile import PlyData; p = PlyData.read('IN.ply'); p.text = False; "
    "p.byte_order = '<'; p.write('OUT.ply')"
)
_END = re.compile(rb"(?:^|\n)end_header(\r?\n)")
_ELEMENT = re.compile(r"\s*element\s+(\S+)\s+([0-9]{1,18})\s*")
SCAFFOLD = ("f_anchor_feat_0", "f_offset_0")  # of Scaffold-GS, whose networks turn anchors into splats

_GSPLAT = {"x", "y", "z", "f_dc_0", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_3"}
_SIGNATURES = {
    "Inria 3DGS": {*_GSPLAT, "nx"},
    "gsplat": _GSPLAT,
    "2DGS": {*_GSPLAT, "nx"} - {"scale_2"},
    "DBS": {*_GSPLAT, "sh0_0", "beta"} - {"f_dc_0"},
    "a point cloud, which has no splats": {"x", "y", "z", "red", "green", "blue", "nx"},
}


@dataclass(frozen=True)
class Slot:
    """Where a column lives: a field of ``Splats`` and the index behind the splat's."""

    field: str
    index: tuple[int, ...]


def recognise_kernel(names: Collection[str]) -> Kernel:
    """The kernel that the columns speak of."""
    if "beta" in names or "sb_params_0" in names or "sh0_0" in names:
        return Kernel.BETA
    if "scale_1" in names and "scale_2" not in names:
        return Kernel.GAUSSIAN_2D
    return Kernel.GAUSSIAN_3D


def model_slots(names: Sequence[str], kernel: Kernel, source: str) -> dict[str, Slot]:
    """The columns that the model knows; the others are extras.

    Raises:
        InvalidSplats: a column of the kernel is missing, there is an odd number of them, or the model is another.
    """
    for name in SCAFFOLD:
        if name in names:
            got = f"anchors of Scaffold-GS, which its networks turn into splats (property {name!r})"
            raise InvalidSplats(source, expected="splats", got=got, hint="export the splats themselves")
    slots = _required(kernel)
    for name in slots:
        if name not in names:
            some = ", ".join([*names[:8], "..."] if len(names) > 8 else names)
            raise InvalidSplats(
                source,
                expected=f"the property {name!r} of a {kernel} splat",
                got=f"{len(names)} properties without it ({some})",
                hint=f"the nearest dialect is {nearest_dialect(names)}",
            )
    slots |= _colour(names, source)
    if kernel is Kernel.BETA:
        slots |= _lobes(names, source)
    return slots


def usual_layout(kernel: Kernel, sh_rows: int, lobes: int) -> tuple[str, ...]:
    """The column order of the kernel's own trainer, for ``sh_rows`` coefficients a channel and S lobes."""
    is_beta = kernel is Kernel.BETA
    first, rest = ("sh0", "shN") if is_beta else ("f_dc", "f_rest")
    names = ["x", "y", "z", *NORMALS]
    if sh_rows:
        names += [f"{first}_{i}" for i in range(3)]
        names += [f"{rest}_{i}" for i in range(3 * (sh_rows - 1))]
    names += [f"sb_params_{i}" for i in range(LOBE_CHANNELS * lobes)]
    names += ["opacity", *(["beta"] if is_beta else [])]
    names += [f"scale_{i}" for i in range(scale_count(kernel))]
    return (*names, *(f"rot_{i}" for i in range(4)))


def scale_count(kernel: Kernel) -> int:
    """Two for the flat splats of 2DGS, three for the others."""
    return 2 if kernel is Kernel.GAUSSIAN_2D else 3


def nearest_dialect(names: Collection[str]) -> str:
    """The dialect that shares most of these columns."""
    found = set(names)
    return max(_SIGNATURES, key=lambda dialect: len(_SIGNATURES[dialect] & found) / len(_SIGNATURES[dialect]))


def _required(kernel: Kernel) -> dict[str, Slot]:
    slots = {axis: Slot("means", (i,)) for i, axis in enumerate("xyz")}
    slots["opacity"] = Slot("opacity_logits", ())
    slots |= {f"scale_{i}": Slot("log_scales", (i,)) for i in range(scale_count(kernel))}
    slots |= {f"rot_{i}": Slot("quats", (i,)) for i in range(4)}
    if kernel is Kernel.BETA:
        slots["beta"] = Slot("beta", ())
    return slots


def _colour(names: Sequence[str], source: str) -> dict[str, Slot]:
    first, rest = ("sh0", "shN") if "sh0_0" in names else ("f_dc", "f_rest")
    base = _numbered(names, first, source)
    higher = _numbered(names, rest, source)
    if not base and not higher:
        return {}
    rows = higher // 3
    complete = [(degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1)]
    if base != 3 or higher % 3 or rows not in complete:
        counts = ", ".join(str(3 * count) for count in complete)
        raise InvalidSplats(
            source,
            expected=f"3 properties {first}_* and {counts} properties {rest}_* (degree 0..{MAX_SH_DEGREE})",
            got=f"{base} and {higher}",
            hint=f"the nearest dialect is {nearest_dialect(names)}",
        )
    slots = {f"{first}_{c}": Slot("sh", (0, c)) for c in range(3)}
    return slots | {f"{rest}_{i}": Slot("sh", (1 + i % rows, i // rows)) for i in range(higher)}


def _lobes(names: Sequence[str], source: str) -> dict[str, Slot]:
    count = _numbered(names, "sb_params", source)
    if count % LOBE_CHANNELS:
        raise InvalidSplats(source, expected=f"a multiple of {LOBE_CHANNELS} properties sb_params_*", got=str(count))
    lobes = count // LOBE_CHANNELS
    return {f"sb_params_{i}": Slot("sb_params", (i % lobes, i // lobes)) for i in range(count)}


def _numbered(names: Sequence[str], stem: str, source: str) -> int:
    """How many columns ``stem_0, stem_1, ...`` there are; they must have no gap."""
    pattern = re.compile(re.escape(stem) + r"_(0|[1-9][0-9]{0,5})")
    indices = sorted(int(match[1]) for match in map(pattern.fullmatch, names) if match)
    for wanted, found in enumerate(indices):
        if found != wanted:
            raise InvalidSplats(
                source,
                expected=f"the property '{stem}_{wanted}'",
                got=f"'{stem}_{found}' without it",
                hint=f"the nearest dialect is {nearest_dialect(names)}",
            )
    return len(indices)


@dataclass(frozen=True)
class PlyHeader:
    """A header that fits its file: a vertex element of scalar columns before any other, little-endian."""

    lines: tuple[str, ...]  # verbatim, with end_header, without the line feeds and what describes other elements
    count: int  # rows
    dtype: np.dtype  # of a row, a field a column
    data_offset: int  # bytes before the first row
    after: int | None = 0  # bytes behind the last row, of other elements; None when their lists make it unknown

    @property
    def names(self) -> tuple[str, ...]:
        """The columns, in the order of the file."""
        return self.dtype.names or ()

    def lines_for(self, count: int) -> list[str]:
        """The lines of a file with ``count`` rows of these columns; all but that number stays as it is."""
        end = "\r" if self.lines[0].endswith("\r") else ""
        changed = f"element vertex {count}{end}"
        is_same = count == self.count
        return [changed if line.split()[:1] == ["element"] and not is_same else line for line in self.lines]


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
        got = f"one that does not open ({error.strerror})"
        raise InvalidSplats(str(path), expected="a splat file", got=got) from None
    header = parse_header(head, str(path))
    found, stride = size - header.data_offset, header.dtype.itemsize
    least = header.count * stride + (header.after or 0)
    if found < least or (header.after is not None and found > least):
        hint = "the file has bytes that its header does not describe: export it again"
        if found < least:
            hint = "the file is truncated: copy or export it again"
        others = f" and {header.after} bytes of other elements" if header.after else ""
        expected = f"{header.count} rows of {stride} bytes{others} = {least} bytes after the header"
        raise InvalidSplats(str(path), expected=expected, got=f"{found} bytes", hint=hint)
    return header


def parse_header(head: bytes, source: str) -> PlyHeader:
    """Parse the first bytes of a PLY; ``source`` names the file in errors.

    Raises:
        InvalidSplats: the bytes are not the header of a splat PLY.
    """

    from plyfile import PlyData, PlyListProperty, PlyParseError  # here: processes that read no PLY start sooner

    def refuse(expected: str, got: str, hint: str = EXPORT) -> InvalidSplats:
        return InvalidSplats(f"{source} header", expected=expected, got=got, hint=hint)

    lines, offset = _header_lines(head, source)
    counts: list[int] = []
    empty: list[str] = []  # the same header of no rows, which plyfile reads without any data
    for line in lines:
        words, element = line.split(), _ELEMENT.fullmatch(line)
        if words[:1] == ["element"] and element is None:
            expected = "the name of an element and a count of zero or more"
            raise refuse(expected, repr(" ".join(words)[:60]))
        counts += [int(element[2])] if element else []
        empty.append(f"element {element[1]} 0" if element else line.removesuffix("\r"))
    try:
        ply = PlyData.read(io.BytesIO(header_bytes(empty)))
    except (PlyParseError, ValueError) as error:
        raise refuse("a header of PLY 1.0", f"one that does not parse ({str(error)[:120]})") from None
    if ply.text or ply.byte_order != "<":
        kind = "ascii" if ply.text else "binary_big_endian"
        raise refuse("'format binary_little_endian 1.0'", f"'format {kind} 1.0'", REWRITE)
    first = next(iter(ply.elements), None)
    if first is None or not first.properties:
        raise refuse("an element 'vertex' with properties", "a header without one")
    if first.name == "chunk":
        raise refuse("plain splats", "SuperSplat's compressed PLY", CONVERT)
    if first.name != "vertex":
        raise refuse("'vertex' as the first element", repr(first.name[:60]))
    listed = next((column.name for column in first.properties if isinstance(column, PlyListProperty)), None)
    if listed is not None:
        raise refuse("scalar properties ('property float x')", f"a list {listed[:60]!r}")
    after: int | None = 0
    for element, count in zip(ply.elements[1:], counts[1:], strict=True):
        if count and any(isinstance(column, PlyListProperty) for column in element.properties):
            after = None
        elif after is not None:
            after += count * sum(np.dtype(column.val_dtype).itemsize for column in element.properties)
    own = [i for i, line in enumerate(lines) if line.split()[:1] == ["element"]][1:2] or [len(lines) - 1]
    dtype = np.dtype([(column.name, "<" + column.val_dtype) for column in first.properties])
    return PlyHeader((*lines[: own[0]], lines[-1]), counts[0], dtype, offset, after)


def _header_lines(head: bytes, source: str) -> tuple[tuple[str, ...], int]:
    """The lines of a header without their line feeds, and its length in bytes."""
    if head[:4] not in (b"ply\n", b"ply\r"):
        foreign = foreign_format(head, Path(source).suffix)
        begins = f"a file that begins with {head[:8]!r}" if head else "an empty file"
        got, hint = foreign or (begins, f"{EXPORT}; if it is a .splat or a .ksplat, {CONVERT}")
        raise InvalidSplats(source, expected="a PLY file (first line 'ply')", got=got, hint=hint)
    end = _END.search(head)
    if end is None:
        limit = f"'end_header' within the first {MAX_HEADER_BYTES} bytes"
        raise InvalidSplats(source, expected=limit, got=f"none in {len(head)} bytes", hint=EXPORT)
    text = head[: end.end() - 1]
    if not text.isascii():
        hint = "take the comments with other characters out of it"
        raise InvalidSplats(source, expected="an ASCII header", got="other characters in it", hint=hint)
    lines = tuple(text.decode("ascii").split("\n"))
    if len(lines) > MAX_HEADER_LINES:
        limit, hint = f"at most {MAX_HEADER_LINES} header lines", "leave out properties that are no splat's"
        raise InvalidSplats(source, expected=limit, got=str(len(lines)), hint=hint)
    _refuse_clouds(lines, source)
    return lines, end.end()


def _refuse_clouds(lines: tuple[str, ...], source: str) -> None:
    """Point clouds and meshes: what is wrong with them is not how they are written."""
    words = [line.split() for line in lines]
    names = {line[-1] for line in words if line[:1] == ["property"]}
    if not names.issuperset("xyz") or names.intersection(SPLAT_PROPERTIES):
        return
    is_mesh = any(line[:2] == ["element", "face"] for line in words)
    hint = "give the trained splats; the 3DGS trainers keep them in point_cloud/iteration_N/point_cloud.ply"
    if any(name.startswith("scalar_") for name in names):
        hint = "CloudCompare renames properties (scalar_opacity): give the file that it was opened from"
    expected = "splats (properties such as 'opacity', 'scale_0', 'rot_0')"
    got = f"a {'mesh' if is_mesh else 'point cloud'} without any of them"
    raise InvalidSplats(source, expected=expected, got=got, hint=hint)


def header_bytes(lines: Sequence[str]) -> bytes:
    """The lines of a header as they stand in a file."""
    return "".join(f"{line}\n" for line in lines).encode("ascii")
