"""Splat scenes in PLY files of every dialect: read, written back to the byte, and copied with one thing changed.

Headers are read under limits, and checked against the file's size, before their numbers are used.

One table of columns serves reading and writing, for every dialect: Inria, gsplat (no normals), SAGA and LaGa
(``mask``), 2DGS (two scales) and DBS (``sh0_*``, ``shN_*``, ``sb_params_*``, ``beta``). Colour coefficients and lobes
are stored channel-major: all of red, then green, then blue.

Torch is imported where splats are made, so that processes without it can look at headers.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats, reading
from liftcore.io.files import open_regular
from liftcore.runtime.one_line import join_names
from liftcore.scene.harmonics import SH_C0, constant_terms
from liftcore.scene.kernel import DARK_LOBE, LOBE_COLOURS, NORMALS, Kernel, kernel_named, scale_count
from liftcore.scene.render_mode import RenderMode, RenderModel, kernel_of_mode, mode_beside, mode_of_comments

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

MAX_HEADER_BYTES = 256 * 1024
MAX_HEADER_LINES = 4096
BLOCK_ROWS = 16_384  # rows converted at a time: a few MB, so that memory stays near the file's size
MAX_SH_DEGREE = 4
LOBE_CHANNELS = 6  # of a spherical beta lobe: r g b theta phi beta
COLOUR = ("sh", "sb_params")  # fields that a lift does not need, and most of a file
FILTER = "filter_3D"  # of Mip-Splatting, the column of its smoothing filter
MIP_SPLATTING = f"the column {FILTER!r} of Mip-Splatting"  # which also trains with compensated opacities
UNREAD = {  # columns that change renderings and are not read: the effect of ignoring them, and a pattern of names
    "move, and are lifted as they stand": r"(motion|trbf|omega|velocity|rot_r|rotation_r|scale_t|scaling_t)(_.*)?|"
    r"t|t_.*|time",
    "have a footprint of their own, and are lifted with the kernel's": r"(shape|gamma|nu|nu_degree|beta|kernel)"
    r"(_\d+)?",
    "have opacities that depend on more, and are lifted with the plain ones": r"(opacity_.+|compensation|filter_2D)",
    "have colours that depend on more, and are rendered with the harmonics alone": r"(sb_params|f?_?asg|sg|f_app|"
    r"app|appearance|albedo|base_color|roughness|metallic|specular|transient|embedding)(_.*)?",
}
CHANNELS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)  # of a colour
SPLAT_PROPERTIES = ("opacity", "scale_0", "rot_0", "f_dc_0", "sh0_0", "packed_position")  # one at least
SCAFFOLD = ("f_anchor_feat_0", "f_offset_0")  # of Scaffold-GS, whose networks turn anchors into splats
# Columns that are splats, in any dialect.
MODEL = re.compile(r"[xyz]|opacity|beta|filter_3D|(scale|rot|f_dc|f_rest|sh0|shN|sb_params)_\d+|packed_\w+")
SPELLING = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
SPELLING |= {"f4": "float", "f8": "double"}
WRITTEN_MODE = {RenderModel.ANTIALIASED: "mip", RenderModel.DISCS: "2dgs"}  # as editors read it
EXPORT = "export the splats again as binary little-endian PLY"
EXPORT_PLY = (
    "export the splats as PLY from the program that trained them (nerfstudio: ns-export gaussian-splat; gsplat's "
    "simple_trainer: --save-ply)"
)
TRAINED = "give the trained splats; the 3DGS trainers keep them in point_cloud/iteration_N/point_cloud.ply"
REWRITE = (
    "rewrite it with Python: from plyfile import PlyData; p = PlyData.read('IN.ply'); p.text = False; "
    "p.byte_order = '<'; p.write('OUT.ply')"
)
_END = re.compile(rb"(?:^|\n)end_header[ \t]*(\r?\n)")
_REMARKS = ("comment", "obj_info")  # lines that are kept, and not parsed
PADDING = b"\0 \t\r\n"  # bytes that some programs end a file with
MAX_PADDING_BYTES = 4096  # that are read
FLOAT_BYTES = 4  # of a column that a header may lack
_ELEMENT = re.compile(r"(element \S+) ([0-9]{1,18})")

# ---- splats


def read_ply(path: Path, kernel: Kernel | str, *, colour: bool) -> Splats:
    """Read trained splats from a binary little-endian PLY of any dialect.

    With the kernel ``auto`` it is recognised from the properties, and where these leave it open from what the file
    says (`liftcore.scene.render_mode`). Columns that the model does not know are kept as extras in their own type;
    of files without harmonics, ``red``, ``green`` and ``blue`` are the colour too, the same from everywhere;
    ``double`` columns of the model become float32, positions about an origin near them where that would round them
    coarsely (`Splats`). Without ``colour`` neither colours nor extras are read or
    allocated, and what comes cannot be written back. A ``filter_3D`` becomes part of scales and opacities, which are
    then written as plain splats; elements behind the vertices are neither read nor written.
    """
    import torch

    from liftcore.scene.splats import Splats

    header = read_header(path)
    mode, warnings = mode_of_comments(header.lines)
    if mode is None:
        mode = RenderMode(RenderModel.ANTIALIASED, MIP_SPLATTING) if FILTER in header.names else mode_beside(path)
    kernel = recognise_kernel(header.names, mode) if kernel == "auto" else kernel_named(kernel)
    slots = model_slots(header.names, kernel)
    warnings += (*header.warnings, *unread_warnings(header.names, slots))
    for name in slots:
        code = header.dtype[name].str[1:]
        if code not in ("f4", "f8"):
            hint = "quantised splats must be exported as plain ones"
            raise ValueError(f"float or double as property {name!r}, got {SPELLING[code]}; {hint}")
    if header.count == 0:
        raise ValueError("at least one splat, got an empty scene")
    extra_names = [name for name in header.names if name not in slots]
    if not colour:
        slots = {name: slot for name, slot in slots.items() if slot.field not in COLOUR}
        extra_names = [name for name in extra_names if name == FILTER]
    fields, extras = _read_columns(path, header, slots, extra_names)
    layout, lines = (header.names, header.lines) if colour else ((), ())
    if FILTER in extras:
        lines, layout = (), tuple(name for name in layout if name != FILTER)
        fields |= _apply_filter(fields["log_scales"], fields["opacity_logits"], extras.pop(FILTER))
    if colour and "sh" not in fields and (channels := channel_names(header.names)):
        levels = np.stack([extras[name] for name in channels], axis=1)
        terms = constant_terms(levels / full_level(levels)).astype(np.float32)
        fields["sh"] = np.ascontiguousarray(terms[:, None])
    tensors = {name: torch.from_numpy(values) for name, values in extras.items()}
    origin_fields = {"layout": layout, "header": lines, "render_mode": mode, "warnings": warnings}
    return Splats(**fields, kernel=kernel, extras=tensors, **origin_fields)


def read_places(path: Path) -> np.ndarray:
    """Read the means [P, 3] f32 (f64 of doubles) alone, in the file's frame, without torch."""
    header = read_header(path)
    return _read_columns(path, header, {axis: Slot("means", (k,)) for k, axis in enumerate("xyz")}, ())[0]["means"]


def ply_blocks(splats: Splats) -> Iterator[bytes]:
    """Yield the bytes of a PLY in blocks, in the layout that they were read with or their kernel's usual one."""
    layout = splats.layout or _default_layout(splats)
    columns = _columns_of(splats, layout)
    source = None
    if splats.header:  # describes the columns unless the layout was changed
        with reading("header", InvalidSplats, "the header of a PLY"):
            header = parse_header(header_bytes(splats.header))
        source = header if header.names == splats.layout else None
    codes = {name: source.dtype[name].str[1:] if source else "f4" for name in layout}
    positions = () if source else "xyz"  # doubles where there is an origin
    codes |= {name: columns[name].dtype.str[1:] for name in layout if name in splats.extras or name in positions}
    lines = ["ply", "format binary_little_endian 1.0"]
    if splats.render_mode is not None and (mode := WRITTEN_MODE.get(splats.render_mode.model)):
        lines.append(f"comment SplatRenderMode: {mode}")
    lines.append(f"element vertex {splats.count}")
    lines += [*(f"property {SPELLING[code]} {name}" for name, code in codes.items()), "end_header"]
    dtype = np.dtype([(name, "<" + code) for name, code in codes.items()])
    if source is not None and source.dtype == dtype:
        lines = source.lines_for(splats.count, dtype)
    yield header_bytes(lines)
    for start in range(0, splats.count, BLOCK_ROWS):
        rows = np.zeros(min(BLOCK_ROWS, splats.count - start), dtype)
        for name, column in columns.items():
            rows[name] = column[start : start + len(rows)]
        yield rows.tobytes()


def rewritten(
    path: Path, count: int, columns: Mapping[str, np.ndarray] = MappingProxyType({}), mask: np.ndarray | None = None
) -> Iterator[bytes]:
    """Yield a PLY with other columns and fewer rows, a block at a time; all else stays byte for byte.

    Args:
        path: of a file of ``count`` splats, which is read and not mapped, to bound memory.
        columns: name -> [P]. One that the file has stays in its place, a new one comes behind.
        mask: [P] bool, the rows to keep; None: all.
    """
    header = read_header(path)
    if header.count != count:
        raise ValueError(f"{count} splats, as many as were lifted, got {header.count}")
    types = {name: header.dtype[name] for name in header.names}
    types |= {name: values.dtype.newbyteorder("<") for name, values in columns.items()}
    dtype = np.dtype([*types.items()])
    yield header_bytes(header.lines_for(count if mask is None else int(np.count_nonzero(mask)), dtype))
    with path.open("rb", buffering=0) as source:
        source.seek(header.data_offset)
        for first in range(0, count, BLOCK_ROWS):
            rows = np.fromfile(source, header.dtype, min(BLOCK_ROWS, count - first))
            block = slice(first, first + len(rows))
            changed_rows = rows
            if dtype != header.dtype:
                changed_rows = np.empty(len(rows), dtype)
                for name in types.keys() - columns.keys():
                    changed_rows[name] = rows[name]
            for name, values in columns.items():
                changed_rows[name] = values[block]
            yield (changed_rows if mask is None else changed_rows[mask[block]]).tobytes()


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """Yield a PLY whose splats have one colour each, independent of the view; all else is unchanged byte for byte.

    Higher harmonics become zero. The lobes of DBS become dark and not zero: a lobe of zeros shines. Of files without
    harmonics, red, green and blue are changed, in their type and unit. ``colours`` [P, 3] f32 are constant terms.
    """
    header, columns = read_header(path), dict[str, np.ndarray]()
    for name, slot in model_slots(header.names, recognise_kernel(header.names)).items():
        dtype = header.dtype[name]
        if slot.field == "sh" and slot.index[0] == 0:
            columns[name] = colours[:, slot.index[1]].astype(dtype, copy=False)
        elif slot.field == "sh" or (slot.field == "sb_params" and slot.index[1] < LOBE_COLOURS):
            constant = np.array(0.0 if slot.field == "sh" else DARK_LOBE, dtype)
            columns[name] = np.broadcast_to(constant, len(colours))  # takes no memory
    if not {"f_dc_0", "sh0_0"} & columns.keys():
        channels = channel_names(header.names)
        if not channels:
            raise ValueError("colours (f_dc_0, ...) to show scores in, got a file without any")
        stored = _read_columns(path, header, {}, channels)[1]
        levels = full_level(np.stack([stored[name] for name in channels], axis=1)) * (0.5 + SH_C0 * colours)
        for name, column in zip(channels, levels.T, strict=True):
            dtype = header.dtype[name]
            columns[name] = (column if dtype.kind == "f" else np.rint(column)).astype(dtype)
    yield from rewritten(path, len(colours), columns)


def _read_columns(
    path: Path, header: PlyHeader, slots: Mapping[str, Slot], extra_names: Sequence[str]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the model's fields as f32, means of doubles as f64, and the other columns in their own type."""
    shapes: dict[str, tuple[int, ...]] = {}
    for slot in slots.values():
        corner = shapes.get(slot.field, (0,) * len(slot.index))
        shapes[slot.field] = tuple(max(side, i + 1) for side, i in zip(corner, slot.index, strict=True))
    means = [name for name, slot in slots.items() if slot.field == "means"]
    doubled = {"means"} if any(header.dtype[name] == np.float64 for name in means) else set[str]()
    fields = {
        field: np.empty((header.count, *shape), np.float64 if field in doubled else np.float32)
        for field, shape in shapes.items()
    }
    extras = {name: np.empty(header.count, header.dtype[name]) for name in extra_names}
    targets = {name: fields[slot.field][(slice(None), *slot.index)] for name, slot in slots.items()} | extras
    table = np.memmap(path, header.dtype, "r", header.data_offset, (header.count,))
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is refused as such
        for first in range(0, header.count, BLOCK_ROWS):
            rows = table[first : first + BLOCK_ROWS]
            for name, target in targets.items():
                target[first : first + BLOCK_ROWS] = rows[name]
    return fields, extras


def _apply_filter(
    log_scales: np.ndarray, opacity_logits: np.ndarray, deviations: np.ndarray
) -> dict[str, np.ndarray]:
    """Log scales [P, 3] and opacity logits [P] with the 3D smoothing filter of Mip-Splatting in them.

    Such a scene (and GOF's) is trained with every Gaussian convolved with one of the standard deviation f [P], its
    opacity lowered by as much as its volume grew (Yu et al. 2024, Eq. 8)::

        s' = sqrt(s^2 + f^2),   o' = o sqrt(prod s^2 / prod s'^2)
    """
    if (negative := deviations < 0).any():
        got = f"{float(deviations[negative][0]):g} in splat {int(negative.argmax())}"
        raise ValueError(f"values of {FILTER} of zero or more, got {got}")
    deviations = np.where(np.isposinf(deviations), np.nan, deviations)  # a size that is no number
    scales, theta = log_scales.astype(np.float64), opacity_logits.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # a deviation of zero changes nothing; so do logs of it
        widened = np.logaddexp(2 * scales, 2 * np.log(deviations.astype(np.float64))[:, None]) / 2
        # log of sigmoid(theta) and of what it loses, then the logit of their product
        log_ratio = np.where(np.isinf(scales), -np.inf, scales - widened).sum(axis=1)
        lowered = -np.logaddexp(0.0, -theta) + np.where(deviations > 0, log_ratio, 0.0)
        logits = lowered - np.log(-np.expm1(lowered))
    return {"log_scales": widened.astype(np.float32), "opacity_logits": logits.astype(np.float32)}


def _default_layout(splats: Splats) -> tuple[str, ...]:
    """Return the column order of the kernel's own trainer, and the further columns behind it."""
    sh_rows = 0 if splats.sh is None else splats.sh.shape[1]
    lobes = 0 if splats.sb_params is None else splats.sb_params.shape[1]
    names = [*_columns(splats.kernel, sh_rows, lobes, beta_names=splats.kernel is Kernel.BETA)]
    layout = (*names[:3], *NORMALS, *names[3:])
    return (*layout, *(name for name in splats.extras if name not in layout))


def _columns_of(splats: Splats, layout: Sequence[str]) -> dict[str, np.ndarray]:
    """Column name -> [P]; normals that the splats never had are left out and stay zero."""
    columns: dict[str, np.ndarray] = {}
    with reading("layout", InvalidSplats, "columns of the splats", "clear the layout"):
        slots = model_slots(layout, splats.kernel)
        for name in layout:
            if name in slots:
                field, tensor = slots[name].field, getattr(splats, slots[name].field)
                values = (
                    splats.positions() if field == "means" else np.asarray(None if tensor is None else tensor.cpu())
                )
                columns[name] = values[(slice(None), *slots[name].index)]
            elif name in splats.extras:
                columns[name] = splats.extras[name].cpu().numpy()
            elif name not in NORMALS:
                raise ValueError(repr(name))
    return columns


# ---- columns and the numbers of the model


@dataclass(frozen=True)
class Slot:
    """Place of a column: a field of ``Splats`` and the index behind the splat's."""

    field: str
    index: tuple[int, ...]


def unread_warnings(names: Sequence[str], slots: Mapping[str, Slot]) -> list[str]:
    """Return a warning of each kind of columns that would change what is rendered, if they were read."""
    extra_names = [name for name in names if name not in slots and name != FILTER]
    warnings = []
    for effect, pattern in UNREAD.items():
        unread = [name for name in extra_names if re.fullmatch(pattern, name, re.I)]
        listing = join_names(unread, 3)
        warnings += [f"the properties {listing} are not read: these splats {effect}"] if unread else []
    return warnings


def recognise_kernel(names: Collection[str], mode: RenderMode | None = None) -> Kernel:
    """Return the kernel of the columns; where they leave it open, that of the render mode."""
    if "beta" in names or "sb_params_0" in names or "sh0_0" in names:
        return Kernel.BETA
    if "scale_1" in names and "scale_2" not in names:
        return Kernel.GAUSSIAN_2D
    return kernel_of_mode(mode)


def channel_names(names: Collection[str]) -> tuple[str, ...]:
    """Return the columns of red, green and blue, as nerfstudio's ``--ply-color-mode rgb`` has them; none without."""
    return next((channels for channels in CHANNELS if set(channels) <= set(names)), ())


def full_level(levels: np.ndarray) -> float:
    """Return the level that stands for 1 in levels [P, 3] of red, green and blue: the largest of an integer type.

    Floats are 0..1 in most files and 0..255 in some, where most of them are above 1.
    """
    if levels.dtype.kind != "f":
        return float(np.iinfo(levels.dtype).max)
    finite = levels[np.isfinite(levels)]
    return 255.0 if finite.size and np.median(finite) > 1 else 1.0


def dialect_of(names: Collection[str]) -> str:
    """Return the dialect of these columns, by the kernel and the normals that it has."""
    kernel = recognise_kernel(names)
    if kernel is Kernel.GAUSSIAN_3D:
        return "Inria 3DGS" if "nx" in names else "gsplat"
    return kernel.upper()


def model_slots(names: Sequence[str], kernel: Kernel) -> dict[str, Slot]:
    """Return the columns that are fields of the model; the others are extras."""
    for name in SCAFFOLD:
        if name in names:
            got = f"anchors of Scaffold-GS, which its networks turn into splats (property {name!r})"
            raise ValueError(f"splats, got {got}; export the splats themselves")
    for name in _columns(kernel, 0, 0, beta_names=False):
        if name not in names:
            listing = ", ".join([*names[:8], "..."] if len(names) > 8 else names)
            got = f"{len(names)} properties without it ({listing}); the nearest dialect is {dialect_of(names)}"
            raise ValueError(f"the property {name!r} of a {kernel} splat, got {got}")
    beta_names = "sh0_0" in names
    first, rest = ("sh0", "shN") if beta_names else ("f_dc", "f_rest")
    base, higher = _count_numbered(names, first), _count_numbered(names, rest)
    complete = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]
    if (base, higher) != (0, 0) and (base != 3 or higher not in complete):
        counts = ", ".join(map(str, complete))
        expected = f"3 properties {first}_* and {counts} properties {rest}_* (degree 0..{MAX_SH_DEGREE})"
        raise ValueError(f"{expected}, got {base} and {higher}; {EXPORT}")
    lobes = _count_numbered(names, "sb_params") if kernel is Kernel.BETA else 0
    if lobes % LOBE_CHANNELS:
        raise ValueError(f"a multiple of {LOBE_CHANNELS} properties sb_params_*, got {lobes}")
    return _columns(kernel, (base + higher) // 3, lobes // LOBE_CHANNELS, beta_names=beta_names)


def _columns(kernel: Kernel, sh_rows: int, lobes: int, *, beta_names: bool) -> dict[str, Slot]:
    """Return the columns of a model, in the usual order, without normals."""
    first, rest = ("sh0", "shN") if beta_names else ("f_dc", "f_rest")
    higher = max(0, sh_rows - 1)
    slots = {axis: Slot("means", (i,)) for i, axis in enumerate("xyz")}
    slots |= {f"{first}_{c}": Slot("sh", (0, c)) for c in range(3 if sh_rows else 0)}
    slots |= {f"{rest}_{i}": Slot("sh", (1 + i % higher, i // higher)) for i in range(3 * higher)}
    slots |= {f"sb_params_{i}": Slot("sb_params", (i % lobes, i // lobes)) for i in range(LOBE_CHANNELS * lobes)}
    slots["opacity"] = Slot("opacity_logits", ())
    if kernel is Kernel.BETA:
        slots["beta"] = Slot("beta", ())
    slots |= {f"scale_{i}": Slot("log_scales", (i,)) for i in range(scale_count(kernel))}
    return slots | {f"rot_{i}": Slot("quats", (i,)) for i in range(4)}


def _count_numbered(names: Sequence[str], stem: str) -> int:
    """Count the columns ``stem_0, stem_1, ...``, which must have no gap."""
    pattern = re.compile(re.escape(stem) + r"_(0|[1-9][0-9]{0,5})")
    indices = sorted(int(match[1]) for match in map(pattern.fullmatch, names) if match)
    for expected_index, index in enumerate(indices):
        if index != expected_index:
            raise ValueError(f"the property '{stem}_{expected_index}', got '{stem}_{index}' without it; {EXPORT}")
    return len(indices)


# ---- headers


@dataclass(frozen=True)
class PlyHeader:
    """A header that fits its file: a vertex element of scalar columns before any other, little-endian."""

    lines: tuple[str, ...]  # verbatim, with end_header, without the line feeds and what describes other elements
    count: int  # rows
    dtype: np.dtype  # of a row, a field a column
    data_offset: int  # bytes before the first row
    after: int | None = 0  # bytes behind the last row, of other elements; None when their lists make it unknown
    warnings: tuple[str, ...] = ()  # of bytes behind all of that, which the header does not describe

    @property
    def names(self) -> tuple[str, ...]:
        """The columns, in the order of the file."""
        return self.dtype.names or ()

    def lines_for(self, count: int, dtype: np.dtype) -> list[str]:
        """Return the lines of a file with ``count`` rows of a type; what does not change stays as it is."""
        end = "\r" if self.lines[0].endswith("\r") else ""

        def changed_line(line: str) -> str:
            words = line.split()
            if words[:1] == ["element"] and count != self.count:
                return f"element vertex {count}{end}"
            if words[:1] == ["property"] and dtype[words[-1]] != self.dtype[words[-1]]:
                return property_line(words[-1])
            return line

        def property_line(name: str) -> str:
            return f"property {SPELLING[dtype[name].str[1:]]} {name}{end}"

        new_names = (name for name in dtype.names or () if name not in self.names)
        return [*map(changed_line, self.lines[:-1]), *map(property_line, new_names), self.lines[-1]]


def read_header(path: Path) -> PlyHeader:
    """Read and check the header of a splat PLY, at most 256 KiB of the file.

    Zeros and blanks behind all elements count for nothing: viewers open such files, too.
    """
    head, size = read_head(path)
    header = parse_header(head)
    length, stride = size - header.data_offset, header.dtype.itemsize
    data_bytes = header.count * stride + (header.after or 0)
    warnings = () if header.after is None else tail_warnings(path, size, header.data_offset + data_bytes)
    has_longer_rows = warnings and header.count > 1 and (length - data_bytes) % (FLOAT_BYTES * header.count) == 0
    if length < data_bytes or has_longer_rows:
        hint = "the file is truncated: copy or export it again"
        if has_longer_rows:
            hint = "the rows are longer than their properties in the header: export the file again"
        element_bytes = f" and {header.after} bytes of other elements" if header.after else ""
        expected = f"{header.count} rows of {stride} bytes{element_bytes} = {data_bytes} bytes after the header"
        raise ValueError(f"{expected}, got {length} bytes; {hint}")
    return replace(header, warnings=warnings)


def tail_warnings(path: Path, size: int, described_bytes: int) -> tuple[str, ...]:
    """Warn of bytes at a file's end that its header does not describe, but for a few zeros or blanks."""
    tail = size - described_bytes
    if tail <= 0:
        return ()
    with path.open("rb") as handle:
        handle.seek(described_bytes)
        if tail <= MAX_PADDING_BYTES and not handle.read(tail).strip(PADDING):
            return ()
    return (f"{tail} bytes at the file's end are not described by its header: not read",)


def read_head(path: Path) -> tuple[bytes, int]:
    """Read as many bytes of a file as a header may take, and return them with the file's size."""
    with open_regular(path) as handle:
        return handle.read(MAX_HEADER_BYTES), handle.seek(0, 2)


def parse_header(head: bytes) -> PlyHeader:
    """Parse the first bytes of a PLY of plain splats."""
    lines, elements, offset = parse_elements(head)
    first, *remaining = elements
    if first.name != "vertex":
        raise _header_error("'vertex' as the first element", repr(first.name[:60]))
    if first.list_column is not None:
        raise _header_error("scalar properties ('property float x')", f"a list {first.list_column[:60]!r}")
    has_lists = any(element.count and element.list_column is not None for element in remaining)
    after = None if has_lists else sum(element.count * element.dtype.itemsize for element in remaining)
    ends = [i for i, line in enumerate(lines) if line.split()[:1] == ["element"]][1:2] or [len(lines) - 1]
    return PlyHeader((*lines[: ends[0]], lines[-1]), first.count, first.dtype, offset, after)


@dataclass(frozen=True)
class Element:
    """An element of a header."""

    name: str
    count: int  # rows
    dtype: np.dtype  # of a row, little-endian, a field a column; without its lists
    list_column: str | None  # the first of its columns that is a list


def parse_elements(head: bytes) -> tuple[tuple[str, ...], list[Element], int]:
    """Return the lines of a binary little-endian header, its elements, at least one, and its length in bytes."""
    from plyfile import (
        PlyData,
        PlyListProperty,
        PlyParseError,
    )  # imported here: processes that read no PLY start faster

    lines, offset = _header_lines(head)
    stated_lines = [" ".join(line.split()) for line in lines if line.split() and not line.startswith(_REMARKS)]
    counts: list[int] = []
    for line in stated_lines:
        if line.startswith("element "):
            if (match := _ELEMENT.fullmatch(line)) is None:
                raise _header_error("the name of an element and a count of zero or more", repr(line[:60]))
            counts.append(int(match[2]))
    # The same header of no rows, which plyfile reads without any data.
    empty = [_ELEMENT.sub(r"\1 0", line) for line in stated_lines]
    try:
        ply = PlyData.read(io.BytesIO(header_bytes(empty)))
    except (PlyParseError, ValueError) as error:
        raise _header_error("a header of PLY 1.0", f"one that does not parse ({str(error)[:120]})") from None
    if ply.text or ply.byte_order != "<":
        kind = "ascii" if ply.text else "binary_big_endian"
        raise _header_error("'format binary_little_endian 1.0'", f"'format {kind} 1.0'", REWRITE)
    elements = []
    for element, count in zip(ply.elements, counts, strict=True):
        lists = [column.name for column in element.properties if isinstance(column, PlyListProperty)]
        scalars = [(column.name, "<" + column.val_dtype) for column in element.properties if column.name not in lists]
        elements.append(Element(element.name, count, np.dtype(scalars), lists[0] if lists else None))
    if not elements or not (elements[0].dtype.names or elements[0].list_column):
        raise _header_error("an element 'vertex' with properties", "a header without one")
    return lines, elements, offset


def _header_error(expected: str, got: str, hint: str = EXPORT) -> ValueError:
    return ValueError(f"{expected} in its header, got {got}; {hint}")


def header_bytes(lines: Sequence[str]) -> bytes:
    """Encode the lines of a header; comments may hold any bytes, a character each."""
    return "".join(f"{line}\n" for line in lines).encode("latin-1")


def _header_lines(head: bytes) -> tuple[tuple[str, ...], int]:
    """Return the lines of a header without their line feeds, and its length in bytes."""
    end = _END.search(head)
    if end is None:
        limit = f"'end_header' within the first {MAX_HEADER_BYTES} bytes"
        raise ValueError(f"{limit}, got none in {len(head)} bytes; {EXPORT}")
    lines = tuple(head[: end.end() - 1].decode("latin-1").split("\n"))
    if not all(line.isascii() or line.startswith(_REMARKS) for line in lines):
        expected, got = "ASCII characters in all lines but comments", "other characters in it"
        raise _header_error(expected, got)
    if len(lines) > MAX_HEADER_LINES:
        limit, hint = f"at most {MAX_HEADER_LINES} header lines", "leave out properties that are no splat's"
        raise ValueError(f"{limit}, got {len(lines)}; {hint}")
    return lines, end.end()


def cloud_without_splats(lines: Sequence[str]) -> tuple[str, str] | None:
    """Return the name of a point cloud or mesh by the lines of its header, and what to do with it; None of splats.

    What is wrong with such a file is not how it is written.
    """
    words = [line.split() for line in lines]
    names = {line[-1] for line in words if line[:1] == ["property"]}
    if not names.issuperset("xyz") or names.intersection(SPLAT_PROPERTIES):
        return None
    hint = TRAINED
    if any(name.startswith("scalar_") for name in names):
        hint = "CloudCompare renames properties (scalar_opacity): give the file that it was opened from"
    return ("a mesh" if any(line[:2] == ["element", "face"] for line in words) else "a point cloud"), hint
