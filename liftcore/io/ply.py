"""Splat scenes in PLY files of every dialect: read, written back to the byte, and copied with one thing changed.

Headers are read under limits, and what they say must fit the file's size, before anything trusts their numbers.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidSplats
from liftcore.io.files import LFS_POINTER, whole_file
from liftcore.io.ply_header import (
    NORMALS,
    PlyHeader,
    Slot,
    header_bytes,
    model_slots,
    parse_header,
    read_header,
    recognise_kernel,
    usual_layout,
)
from liftcore.scene.kernel import Kernel, kernel_named
from liftcore.scene.splats import Splats

BLOCK_ROWS = 16_384  # rows converted at a time: a few MB, so that memory stays near the file's size
COLOUR = ("sh", "sb_params")  # fields that a lift has no use for, and most of a file
FILTER = "filter_3D"  # of Mip-Splatting, the column of its smoothing filter
LOBE_COLOURS = 3  # r g b, the first channels of a spherical beta lobe
DARK_LOBE = -10.0  # r g b of a lobe that adds nothing: its softplus of sharpness 10 ln 2 is 1e-31, and of zero 0.1
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")
SPELLING = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
SPELLING |= {"f4": "float", "f8": "double"}
EXPORT_PLY = (
    "export the splats as PLY from the program that trained them (nerfstudio: ns-export gaussian-splat; gsplat's "
    "simple_trainer: --save-ply)"
)


def read_splats(path: Path | str, kernel: Kernel | str = "auto", *, colour: bool = True) -> Splats:
    """Read trained splats from a binary little-endian PLY of any dialect.

    With the kernel ``auto`` it is recognised from the properties. Columns that the model does not know are kept as
    extras in their own type; ``double`` columns of the model become float32. Without ``colour`` neither colours nor
    extras are read or allocated, and what comes cannot be written back. A ``filter_3D`` becomes part of scales and
    opacities, which are then written as plain splats; elements behind the vertices are neither read nor written.

    Raises:
        InvalidSplats: the file is malformed, lacks a property of the kernel, or holds NaN or no splats.
    """
    path = Path(path)
    if path.suffix.lower() in PICKLED and not _begins(path, LFS_POINTER):
        got = "a Python pickle, which may run code when it is opened"
        raise InvalidSplats(str(path), expected="a PLY file", got=got, hint=EXPORT_PLY)
    header = read_header(path)
    kernel = recognise_kernel(header.names) if kernel == "auto" else kernel_named(kernel)
    slots = model_slots(header.names, kernel, str(path))
    for name in slots:
        code = header.dtype[name].str[1:]
        if code not in ("f4", "f8"):
            hint = "quantised splats must be exported as plain ones"
            argument = f"{path} property {name!r}"
            raise InvalidSplats(argument, expected="float or double", got=SPELLING[code], hint=hint)
    if header.count == 0:
        raise InvalidSplats(str(path), expected="at least one splat", got="an empty scene")
    others = [name for name in header.names if name not in slots]
    if not colour:
        slots = {name: slot for name, slot in slots.items() if slot.field not in COLOUR}
        others = [name for name in others if name == FILTER]
    fields, extras = _read_columns(path, header, slots, others)
    layout, lines = (header.names, header.lines) if colour else ((), ())
    with _splats_from(path):
        if FILTER in extras:
            lines, layout = (), tuple(name for name in layout if name != FILTER)
            fields |= _filtered(fields["log_scales"], fields["opacity_logits"], extras.pop(FILTER))
        tensors = {name: torch.from_numpy(values) for name, values in extras.items()}
        return Splats(**fields, kernel=kernel, extras=tensors, layout=layout, header=lines)


def write_splats(splats: Splats, path: Path) -> None:
    """Write splats whole or not at all: the layout they were read with, or else their kernel's usual one.

    Raises:
        InvalidSplats: the layout names a column that the splats do not have.
    """
    layout = splats.layout or _default_layout(splats)
    columns = _columns_of(splats, layout)
    source = _source_header(splats)
    codes = {name: source.dtype[name].str[1:] if source else "f4" for name in layout}
    codes |= {name: columns[name].dtype.str[1:] for name in layout if name in splats.extras}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {splats.count}"]
    lines += [*(f"property {SPELLING[code]} {name}" for name, code in codes.items()), "end_header"]
    dtype = np.dtype([(name, "<" + code) for name, code in codes.items()])
    if source is not None and source.dtype == dtype:
        lines = source.lines_for(splats.count)
    with whole_file(path) as handle:
        handle.write(header_bytes(lines))
        for start in range(0, splats.count, BLOCK_ROWS):
            rows = np.zeros(min(BLOCK_ROWS, splats.count - start), dtype)
            for name, column in columns.items():
                rows[name] = column[start : start + len(rows)]
            handle.write(rows.tobytes())


def some_rows(path: Path, kept: np.ndarray) -> Iterator[bytes]:
    """A splat file with some of its rows, of its own bytes, a block of rows at a time.

    Args:
        path: the file.
        kept: [P] bool, the rows to keep, in the order of the file.

    Yields:
        The bytes of the copy, in blocks.

    Raises:
        InvalidSplats: the file is malformed, or has another number of splats.
    """
    header = _header_of(path, len(kept))
    yield header_bytes(header.lines_for(int(np.count_nonzero(kept))))
    for first, rows in _blocks(path, header):
        yield rows[kept[first : first + len(rows)]].tobytes()


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """A splat file whose splats have one colour each, the same from everywhere; all else is of its own bytes.

    Higher harmonics become zero. The lobes of DBS become dark and not zero: a lobe of zeros shines.

    Args:
        path: the file.
        colours: [P, 3] f32, the constant terms of the spherical harmonics (``f_dc_*``, or ``sh0_*`` of DBS).

    Yields:
        The bytes of the copy, in blocks.

    Raises:
        InvalidSplats: the file is malformed, has another number of splats, or holds no colours.
    """
    header = _header_of(path, len(colours))
    slots = model_slots(header.names, recognise_kernel(header.names), str(path))
    harmonics = {name: slot.index for name, slot in slots.items() if slot.field == "sh"}
    lobes = {name: slot.index for name, slot in slots.items() if slot.field == "sb_params"}
    if not harmonics:
        raise InvalidSplats(str(path), expected="colours (f_dc_0, ...) to show scores in", got="a file without any")
    fixed = {name: 0.0 for name, (row, _) in harmonics.items() if row > 0}
    fixed |= {name: DARK_LOBE for name, (_, channel) in lobes.items() if channel < LOBE_COLOURS}
    yield header_bytes(header.lines)
    for first, rows in _blocks(path, header):
        for name, value in fixed.items():
            rows[name] = value
        for name, (row, channel) in harmonics.items():
            if row == 0:
                rows[name] = colours[first : first + len(rows), channel]
        yield rows.tobytes()


def _begins(path: Path, first: bytes) -> bool:
    try:
        with path.open("rb") as handle:
            return handle.read(len(first)) == first
    except OSError:
        return False


def _header_of(path: Path, count: int) -> PlyHeader:
    header = read_header(path)
    if header.count != count:
        raise InvalidSplats(str(path), expected=f"{count} splats, as many as were lifted", got=str(header.count))
    return header


def _blocks(path: Path, header: PlyHeader) -> Iterator[tuple[int, np.ndarray]]:
    """The number of the first row, and rows with a field a column. Read, not mapped: what was copied is let go."""
    with path.open("rb", buffering=0) as source:
        source.seek(header.data_offset)
        for first in range(0, header.count, BLOCK_ROWS):
            yield first, np.fromfile(source, header.dtype, min(BLOCK_ROWS, header.count - first))


def _read_columns(
    path: Path, header: PlyHeader, slots: Mapping[str, Slot], others: Sequence[str]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The model's fields as f32, and the other columns in their own type."""
    shapes: dict[str, tuple[int, ...]] = {}
    for slot in slots.values():
        corner = shapes.get(slot.field, (0,) * len(slot.index))
        shapes[slot.field] = tuple(max(side, i + 1) for side, i in zip(corner, slot.index, strict=True))
    fields = {field: np.empty((header.count, *shape), np.float32) for field, shape in shapes.items()}
    extras = {name: np.empty(header.count, header.dtype[name]) for name in others}
    targets = {name: fields[slot.field][(slice(None), *slot.index)] for name, slot in slots.items()} | extras
    table = np.memmap(path, header.dtype, "r", header.data_offset, (header.count,))
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is refused as such
        for first in range(0, header.count, BLOCK_ROWS):
            rows = table[first : first + BLOCK_ROWS]
            for name, target in targets.items():
                target[first : first + BLOCK_ROWS] = rows[name]
    return fields, extras


def _filtered(log_scales: np.ndarray, opacity_logits: np.ndarray, deviations: np.ndarray) -> dict[str, np.ndarray]:
    """Log scales [P, 3] and opacity logits [P] with the 3D smoothing filter of Mip-Splatting in them.

    Such a scene (and GOF's) is trained with every Gaussian convolved with one of the standard deviation f [P], its
    opacity lowered by as much as its volume grew (Yu et al. 2024, Eq. 8)::

        s' = sqrt(s^2 + f^2),   o' = o sqrt(prod s^2 / prod s'^2)
    """
    bad = ~(np.isfinite(deviations) & (deviations >= 0))
    if bad.any():
        got = f"{float(deviations[bad][0]):g} in splat {int(bad.argmax())}"
        raise InvalidSplats(FILTER, expected="finite values of zero or more", got=got, hint="export the splats again")
    scales, theta = log_scales.astype(np.float64), opacity_logits.astype(np.float64)
    with np.errstate(divide="ignore"):  # a deviation of zero changes nothing; so do logs of it
        widened = np.logaddexp(2 * scales, 2 * np.log(deviations.astype(np.float64))[:, None]) / 2
        # log of sigmoid(theta) and of what it loses, then the logit of their product
        lost = np.where(np.isinf(scales), -np.inf, scales - widened).sum(axis=1)
        lowered = -np.logaddexp(0.0, -theta) + np.where(deviations > 0, lost, 0.0)
        logits = lowered - np.log(-np.expm1(lowered))
    return {"log_scales": widened.astype(np.float32), "opacity_logits": logits.astype(np.float32)}


@contextmanager
def _splats_from(path: Path) -> Iterator[None]:
    """Name the file in what the splats themselves find wrong."""
    try:
        yield
    except InvalidSplats as error:
        argument = f"{path} {error.argument}"
        raise InvalidSplats(argument, expected=error.expected, got=error.got, hint=error.hint) from None


def _default_layout(splats: Splats) -> tuple[str, ...]:
    sh_rows = 0 if splats.sh is None else splats.sh.shape[1]
    lobes = 0 if splats.sb_params is None else splats.sb_params.shape[1]
    usual = usual_layout(splats.kernel, sh_rows, lobes)
    return (*usual, *(name for name in splats.extras if name not in usual))


def _columns_of(splats: Splats, layout: Sequence[str]) -> dict[str, np.ndarray]:
    """Column name -> [P]; normals that the splats never had are left out and stay zero."""
    slots = model_slots(layout, splats.kernel, "layout")
    columns: dict[str, np.ndarray] = {}
    for name in layout:
        if name in slots:
            values: Tensor | None = getattr(splats, slots[name].field)
            index = slots[name].index
            if values is None or any(i >= n for i, n in zip(index, values.shape[1:], strict=True)):
                expected, hint = "columns of the splats", "clear the layout"
                raise InvalidSplats("layout", expected=expected, got=repr(name), hint=hint)
            columns[name] = values.cpu().numpy()[(slice(None), *index)]
        elif name in splats.extras:
            columns[name] = splats.extras[name].cpu().numpy()
        elif name not in NORMALS:
            raise InvalidSplats("layout", expected="columns of the splats", got=repr(name))
    return columns


def _source_header(splats: Splats) -> PlyHeader | None:
    """The header that the splats were read with, if it still describes their columns."""
    if not splats.header:
        return None
    header = parse_header(header_bytes(splats.header), "header")
    return header if header.names == splats.layout else None
