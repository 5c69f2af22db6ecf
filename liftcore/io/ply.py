"""Splat scenes in PLY files, every dialect of the field: what is read can be written back to the byte."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidSplats
from liftcore.io.files import LFS_POINTER, whole_file
from liftcore.io.ply_dialect import NORMALS, Slot, model_slots, recognise_kernel, usual_layout
from liftcore.io.ply_header import SCALAR_TYPES, PlyHeader, PlyProperty, parse_header, read_header
from liftcore.scene.kernel import Kernel, kernel_named
from liftcore.scene.mip_filter import FILTER, filtered
from liftcore.scene.splats import Splats

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from torch import Tensor

BLOCK_ROWS = 16_384  # rows converted at a time: a few MB, so that memory stays near the file's size
COLOUR = ("sh", "sb_params")  # fields that a lift has no use for, and most of a file

_SPELLING = {code: name for name, code in reversed(SCALAR_TYPES.items())}  # the C names: "float", "uchar"


EXPORT = (
    "export the splats as PLY from the program that trained them (nerfstudio: ns-export gaussian-splat; gsplat's "
    "simple_trainer: --save-ply)"
)
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")


def read_splats(path: Path | str, kernel: Kernel | str = "auto", *, colour: bool = True) -> Splats:
    """Read trained splats from a binary little-endian PLY of any dialect.

    With the kernel ``auto`` it is recognised from the properties. Columns that the model does not know are
    kept as extras in their own type; ``double`` columns of the model become float32. Without ``colour`` neither
    colours nor extras are read or allocated, and what comes cannot be written back. A ``filter_3D`` becomes part of
    scales and opacities (`mip_filter`), which are then written as plain splats; elements behind the vertices are
    neither read nor written.

    Raises:
        InvalidSplats: the file is malformed, lacks a property of the kernel, or holds NaN or no splats.
    """
    path = Path(path)
    if path.suffix.lower() in PICKLED and not _begins(path, LFS_POINTER):
        got = "a Python pickle, which may run code when it is opened"
        raise InvalidSplats(str(path), expected="a PLY file", got=got, hint=EXPORT)
    header = read_header(path)
    names = [column.name for column in header.properties]
    kernel = recognise_kernel(names) if kernel == "auto" else kernel_named(kernel)
    slots = model_slots(names, kernel, str(path))
    for column in header.properties:
        if column.name in slots and column.code not in ("f4", "f8"):
            raise InvalidSplats(
                f"{path} property {column.name!r}",
                expected="float or double",
                got=_SPELLING[column.code],
                hint="quantised splats must be exported as plain ones",
            )
    if header.count == 0:
        raise InvalidSplats(str(path), expected="at least one splat", got="an empty scene")
    others = [column for column in header.properties if column.name not in slots]
    if not colour:
        slots = {name: slot for name, slot in slots.items() if slot.field not in COLOUR}
        others = [column for column in others if column.name == FILTER]
    fields, extras = _read_columns(path, header, slots, others)
    layout, lines = (tuple(names), header.lines) if colour else ((), ())
    with _named(path):
        if FILTER in extras:
            lines, layout = (), tuple(name for name in layout if name != FILTER)
            fields |= _filtered(fields, extras.pop(FILTER))
        return Splats(**fields, kernel=kernel, extras=extras, layout=layout, header=lines)


def _begins(path: Path, first: bytes) -> bool:
    try:
        with path.open("rb") as handle:
            return handle.read(len(first)) == first
    except OSError:
        return False


def write_splats(splats: Splats, path: Path) -> None:
    """Write splats whole or not at all: the layout they were read with, or else their kernel's usual one.

    Raises:
        InvalidSplats: the layout names a column that the splats do not have.
    """
    layout = splats.layout or _default_layout(splats)
    columns = _columns_of(splats, layout)
    codes = _codes(splats, layout)
    dtype = np.dtype([(name, "<" + codes[name]) for name in layout])
    with whole_file(path) as handle:
        handle.write("".join(f"{line}\n" for line in _header_lines(splats, codes)).encode("ascii"))
        for start in range(0, splats.count, BLOCK_ROWS):
            rows = np.zeros(min(BLOCK_ROWS, splats.count - start), dtype)
            for name, column in columns.items():
                rows[name] = column[start : start + len(rows)]
            handle.write(rows.tobytes())


def _read_columns(
    path: Path, header: PlyHeader, slots: Mapping[str, Slot], others: Sequence[PlyProperty]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    fields = {field: np.empty((header.count, *shape), np.float32) for field, shape in _field_shapes(slots).items()}
    extras = {column.name: np.empty(header.count, column.code) for column in others}
    targets = {name: fields[slot.field][(slice(None), *slot.index)] for name, slot in slots.items()} | extras
    table = _mapped_rows(path)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is refused as such
        for start in range(0, header.count, BLOCK_ROWS):
            rows = table[start : start + BLOCK_ROWS]
            for name, target in targets.items():
                target[start : start + BLOCK_ROWS] = rows[name]
    return _tensors(fields), _tensors(extras)


def _filtered(fields: Mapping[str, Tensor], deviations: Tensor) -> dict[str, Tensor]:
    scales, logits = filtered(fields["log_scales"].numpy(), fields["opacity_logits"].numpy(), deviations.numpy())
    return _tensors({"log_scales": scales, "opacity_logits": logits})


def _field_shapes(slots: Mapping[str, Slot]) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for slot in slots.values():
        corner = shapes.get(slot.field, (0,) * len(slot.index))
        shapes[slot.field] = tuple(max(side, i + 1) for side, i in zip(corner, slot.index, strict=True))
    return shapes


def _mapped_rows(path: Path) -> np.ndarray:
    from plyfile import PlyData, PlyParseError

    try:
        return PlyData.read(str(path), mmap="r")["vertex"].data
    except (PlyParseError, ValueError, OSError) as error:
        raise InvalidSplats(str(path), expected="a PLY file", got=f"one that does not parse ({error})") from None


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the file in what the splats themselves find wrong."""
    try:
        yield
    except InvalidSplats as error:
        raise InvalidSplats(
            f"{path} {error.argument}", expected=error.expected, got=error.got, hint=error.hint
        ) from None


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
            columns[name] = _model_column(splats, name, slots[name])
        elif name in splats.extras:
            columns[name] = splats.extras[name].numpy()
        elif name not in NORMALS:
            raise InvalidSplats("layout", expected="columns of the splats", got=repr(name))
    return columns


def _model_column(splats: Splats, name: str, slot: Slot) -> np.ndarray:
    values: Tensor | None = getattr(splats, slot.field)
    if values is None or any(i >= n for i, n in zip(slot.index, values.shape[1:], strict=True)):
        raise InvalidSplats("layout", expected="columns of the splats", got=repr(name), hint="clear the layout")
    return values.numpy()[(slice(None), *slot.index)]


def _source_header(splats: Splats) -> PlyHeader | None:
    """The header that the splats were read with, if it still describes their columns."""
    if not splats.header:
        return None
    header = parse_header("".join(f"{line}\n" for line in splats.header).encode("ascii"), "header")
    return header if tuple(column.name for column in header.properties) == splats.layout else None


def _codes(splats: Splats, layout: Sequence[str]) -> dict[str, str]:
    source = _source_header(splats)
    codes = dict.fromkeys(layout, "f4")
    if source is not None:
        codes |= {column.name: column.code for column in source.properties}
    extras = {name: splats.extras[name].numpy().dtype.str[1:] for name in layout if name in splats.extras}
    return codes | extras


def _header_lines(splats: Splats, codes: Mapping[str, str]) -> list[str]:
    source = _source_header(splats)
    if source is not None and {column.name: column.code for column in source.properties} == codes:
        return list(source.lines_for(splats.count))
    element = f"element vertex {splats.count}"
    columns = [f"property {_SPELLING[code]} {name}" for name, code in codes.items()]
    return ["ply", "format binary_little_endian 1.0", element, *columns, "end_header"]
