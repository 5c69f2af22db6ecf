"""Splat files: recognise the format by content, read, write and copy.

All formats have a row of each splat, and ours are the file's rows in their order. The error of a file of another kind
names its kind and what to do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats, naming, reading
from liftcore.io import ply
from liftcore.io.files import CONVERT_PLY, whole_file
from liftcore.io.formats import WRITERS, SplatFormat
from liftcore.io.kinds import CONVERT, identify, wrong_kind
from liftcore.io.labels import COLUMN, Labels
from liftcore.io.sog import is_bundled, sog_files
from liftcore.io.splat import ROW
from liftcore.runtime.arguments import as_path, one_of
from liftcore.scene.harmonics import constant_terms
from liftcore.scene.kernel import Kernel, kernel_named
from liftcore.scene.origin import lies_apart
from liftcore.scene.render_mode import kernel_of_mode
from liftcore.scene.world import world_of

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.io.formats import Writer
    from liftcore.scene.splats import Splats
    from liftcore.scene.world import WorldFrame


EXPECTED = "splats as PLY, compressed PLY, .splat, .spz, .sog, .glb or a checkpoint"
WITH_COLUMNS = [suffix for suffix, row in WRITERS.items() if row.has_columns]


def read_splats(path: Path | str, kernel: Kernel | str = "auto", *, colour: bool = True) -> Splats:
    """Read trained splats from a file of any `SplatFormat`, recognised by content.

    With the kernel ``auto`` it is recognised from the columns of a PLY, or from the file's render mode
    (`liftcore.scene.render_mode`); without either it is 3D Gaussians. Without ``colour`` neither colours nor other
    fields that a lift does not need are read, and the splats cannot be written back. More of PLYs is in
    `liftcore.io.ply.read_ply`. Checkpoints are opened for tensors alone: no code of theirs runs.

    Args:
        path: a file, or a folder of a SOG.
        kernel: auto, 3dgs, 2dgs or dbs. colour: whether colours and further columns are read.

    Raises:
        InvalidSplats: the file is malformed or of no such format, lacks a property of the kernel, or holds no splat
            of finite numbers.
    """
    path = as_path(path)
    splat_format = format_of(path)
    with _reading(path):
        if splat_format.read is None:
            return ply.read_ply(path, kernel, colour=colour)
        if kernel != "auto" and kernel_named(kernel) is Kernel.BETA:
            raise ValueError(f"the property 'beta' of a dbs splat, got {splat_format.label}, which has none")
        from liftcore.scene.splats import Splats

        fields = splat_format.read(path, colour=colour)
        used_kernel = kernel_of_mode(fields.get("render_mode")) if kernel == "auto" else kernel_named(kernel)
        if used_kernel is Kernel.GAUSSIAN_2D:
            fields["log_scales"] = np.ascontiguousarray(fields["log_scales"][:, :2])
        return Splats(**fields, kernel=used_kernel)


def write_splats(path: Path | str, splats: Splats, columns: Mapping[str, Any] | None = None) -> None:
    """Write splats atomically, as a PLY or in the format of the suffix: .splat, .spz, .glb, .usdc or .usdz.

    A PLY keeps the layout and the further columns that the splats were read with.

    Args:
        path: a file. A name without a suffix is a PLY.
        columns: of all but ``.splat`` and ``.spz``, further numbers a splat: name -> [P] booleans or numbers of numpy
            or torch, such as ``{"object": result.object, "score": answer.scores}``; one that the splats have is
            replaced.

    Raises:
        InvalidSplats: ``splats`` are something else; columns have another number of rows, a name that PLY does not
            take or that the model has, or come for another format; or the suffix is of none of these.
    """
    from liftcore.scene.splats import Splats

    if not isinstance(splats, Splats):
        got = f"{type(splats).__name__} {splats!r}"[:80]
        raise InvalidSplats("splats", expected="Splats, behind the path", got=got, hint="write_splats(path, splats)")
    suffix = Path(str(path)).suffix.lower() or ".ply"
    write = _writer_of(suffix, "path")
    if columns and suffix not in WITH_COLUMNS:
        expected = f"a path that ends in {' or '.join(WITH_COLUMNS)}, which hold columns"
        raise InvalidSplats("columns", expected=expected, got=repr(suffix))
    if columns:
        new_columns: dict[str, Tensor] = {}
        for name, values in columns.items():
            with reading(f"columns[{name!r}]"[:80], InvalidSplats, f"numbers [{splats.count}]"):
                new_columns[str(name)] = _column(name, values, splats.count)
        splats = _with_columns(splats, new_columns)
    with whole_file(as_path(path)) as handle:
        for block in write(splats, None):
            handle.write(block)


def _with_columns(splats: Splats, columns: Mapping[str, Tensor]) -> Splats:
    layout = tuple(dict.fromkeys((*splats.layout, *columns))) if splats.layout else ()
    return replace(splats, extras={**splats.extras, **columns}, layout=layout)


def _column(name: Any, values: Any, count: int) -> Tensor:
    """Convert values to a column [P] of a type that PLY has."""
    import torch

    from liftcore.scene.splats import shared_tensor

    if not isinstance(name, str) or not COLUMN.fullmatch(name) or ply.MODEL.fullmatch(name):
        raise ValueError(
            f"a name of letters, digits and underscores that no property of splats has, got {name!r}"[:160]
        )
    try:
        column = shared_tensor(values).cpu()
    except RuntimeError:
        raise ValueError(f"numbers [{count}], got {values!r}"[:100]) from None
    column = column[:, 0] if column.ndim == 2 and column.shape[1] == 1 else column
    if column.shape != (count,) or column.is_complex():
        hint = "give each of several columns a name" if column.ndim == 2 else ""
        raise ValueError(f"numbers [{count}], got shape {list(column.shape)}; {hint}")
    if column.dtype == torch.bool:
        return column.to(torch.uint8)
    if column.dtype in (torch.float16, torch.bfloat16):
        return column.float()
    if column.dtype in (torch.int64, torch.uint64):
        low, high = int(column.min()), int(column.max())
        if low < -(2**31) or high >= 2**31:
            raise ValueError(f"whole numbers of 32 bits, as PLY has them, got {low}..{high}")
        return column.to(torch.int32)
    return column


def blocks_as(splats: Splats, suffix: str) -> Iterator[bytes]:
    """Encode splats in the format of a suffix, in blocks, with their layout and header where the format has these."""
    return _writer_of(suffix, "suffix")(splats, None)


def _writer_of(suffix: str, argument: str) -> Writer:
    """Return the writer of files with this suffix."""
    write = WRITERS[suffix].write if suffix in WRITERS else None
    if write is None:
        raise InvalidSplats(argument, expected=one_of(WRITERS), got=repr(suffix)[:40], hint=CONVERT_PLY)
    return write


def read_places(path: Path, kernel: Kernel | str = "auto") -> np.ndarray:
    """Read the means [P, 3] f32 or f64 alone, as `Splats.positions` of `read_splats`.

    Only checkpoints and scenes in map coordinates need torch, which takes a second to import. Means that
    are not finite become the first finite one.
    """
    splat_format = format_of(path)
    with _reading(path):
        read = splat_format.read
        places = read(path, colour=False)["means"] if read else ply.read_places(path)
    if lies_apart(places):
        return read_splats(path, kernel, colour=False).positions()
    with np.errstate(over="ignore"):
        places = places.astype(np.float32, copy=False)
    finite = np.isfinite(places).all(axis=1)
    if not finite.all():
        places[~finite] = places[finite.argmax()]
    return places


def format_of(path: Path) -> SplatFormat:
    """Return the format of a file, by its content."""
    identified = identify(path)
    if identified.format is not None:
        return identified.format
    if error := wrong_kind(path, "splats", InvalidSplats, expected=EXPECTED):
        raise error
    hint = identified.hint or (f"{ply.EXPORT}; or {CONVERT}" if path.is_file() else "")
    raise InvalidSplats(str(path), expected=EXPECTED, got=identified.name, hint=hint)


def quick_count(path: Path) -> int | None:
    """P of a file by its header or size alone; None where it must be read to be counted, or does not open."""
    with suppress(InvalidSplats, OSError, ValueError):
        splat_format = format_of(path)
        if splat_format is SplatFormat.SPLAT:
            return path.stat().st_size // ROW.itemsize
        if splat_format.suffix == SplatFormat.PLY.suffix:
            elements = ply.parse_elements(ply.read_head(path)[0])[1]
            return next((element.count for element in elements if element.name == "vertex"), None)
    return None


def splat_files(path: Path) -> list[Path]:
    """Return the files that splats are read from: one, or the several of a SOG that is not bundled."""
    return sog_files(path) if format_of(path) is SplatFormat.SOG and not is_bundled(path) else [path]


def some_rows(path: Path, mask: np.ndarray, suffix: str = ".ply", world: WorldFrame | None = None) -> Iterator[bytes]:
    """Yield some rows of a file, in its order, as the bytes of a PLY or of another written format, in blocks.

    Rows of a PLY stay byte for byte (`liftcore.io.ply.rewritten`); another format becomes a PLY of 3DGS.

    Args:
        mask: [P] bool, the rows to keep. suffix: of the output. world: of its splats; None: the file's.
    """
    write = _writer_of(suffix, "suffix")
    if suffix == ".ply" and format_of(path) is SplatFormat.PLY:
        return _blocks_of(path, ply.rewritten(path, len(mask), mask=mask))
    splats = _of_count(path, len(mask))
    frame = {} if world is None else {"world": world}
    return write(replace(splats[mask], extras={}, layout=(), header=(), **frame), None)


def labelled(path: Path, labels: Labels, suffix: str = ".ply", mask: np.ndarray | None = None) -> Iterator[bytes]:
    """Yield a file with labels, as the bytes of a PLY or of another format that has columns, in blocks.

    From a PLY to a PLY all else stays byte for byte; from another format the PLY has the layout of its kernel.

    Args:
        labels: of its splats, with their ``world``; columns that the file has are replaced. suffix: of the output.
        mask: [P] bool, the rows to keep; None: all.
    """
    write = _writer_of(suffix, "suffix")
    if suffix not in WITH_COLUMNS:
        raise InvalidSplats("suffix", expected=" or ".join(WITH_COLUMNS) + ", which hold labels", got=repr(suffix))
    count = len(next(iter(labels.columns.values())))
    if suffix == ".ply" and mask is None and format_of(path) is SplatFormat.PLY:
        return _blocks_of(path, ply.rewritten(path, count, labels.columns))
    import torch

    splats = _of_count(path, count)
    if mask is not None:
        splats, labels = splats[mask], labels.subset(mask)
    columns = {name: torch.from_numpy(values) for name, values in labels.columns.items()}
    world = world_of(labels.document["world"]) if "world" in labels.document else splats.world
    return write(replace(_with_columns(splats, columns), world=world), labels.document)


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """Yield a file with one view-independent colour of each splat, as the bytes of a PLY in blocks.

    All else of a PLY stays byte for byte (`liftcore.io.ply.recoloured`); another format becomes a PLY of 3DGS. The
    ``colours`` are [P, 3] u8 sRGB.
    """
    terms = constant_terms(colours / 255).astype(np.float32)
    if format_of(path) is SplatFormat.PLY:
        return _blocks_of(path, ply.recoloured(path, terms))
    return ply.ply_blocks(replace(_of_count(path, len(terms), colour=False), sh=terms[:, None]))


def _of_count(path: Path, count: int, *, colour: bool = True) -> Splats:
    splats = read_splats(path, colour=colour)
    if splats.count != count:
        raise InvalidSplats(str(path), expected=f"{count} splats, as many as were lifted", got=str(splats.count))
    return splats


def _blocks_of(path: Path, blocks: Iterator[bytes]) -> Iterator[bytes]:
    with _reading(path):
        yield from blocks


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Name the file in what its reader, or the splats themselves, find wrong."""
    hint = "the file is truncated or damaged: export it again, or as PLY"
    with naming(path), reading(path, InvalidSplats, EXPECTED, hint):
        yield
