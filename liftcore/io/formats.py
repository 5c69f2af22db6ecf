"""Formats of splats, a row each: name, suffix, reader, writer, and whether it holds columns. Loads no torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Any

from liftcore.io.checkpoint import read_checkpoint
from liftcore.io.compressed_ply import read_compressed_ply
from liftcore.io.gltf import gltf_blocks, read_gltf
from liftcore.io.ply import ply_blocks
from liftcore.io.quantised import Fields
from liftcore.io.sog import read_sog
from liftcore.io.splat import read_splat, splat_blocks
from liftcore.io.spz import read_spz, spz_blocks
from liftcore.io.usd import usd_blocks

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

    Document = Mapping[str, Any]  # of `liftcore.io.labels`
    Writer = Callable[[Splats, Document | None], Iterator[bytes]]


@dataclass(frozen=True)
class _Row:
    label: str  # its usual name
    suffix: str
    read: Callable[..., Fields] | None = None  # None: of PLYs (`read_ply`) and of USD, which is not read
    write: Writer | None = None  # None: it is read alone
    has_columns: bool = False  # further numbers a splat


class SplatFormat(_Row, Enum):
    """A format of splats."""

    PLY = "PLY", ".ply", None, lambda splats, _: ply_blocks(splats), True  # of every dialect
    COMPRESSED_PLY = "compressed PLY", ".ply", read_compressed_ply
    SPLAT = ".splat", ".splat", read_splat, lambda splats, _: splat_blocks(splats)
    SPZ = ".spz", ".spz", read_spz, lambda splats, _: spz_blocks(splats)
    SOG = ".sog", ".sog", read_sog
    GLTF = ".glb", ".glb", read_gltf, gltf_blocks, True  # with KHR_gaussian_splatting
    CHECKPOINT = "checkpoint", ".pt", read_checkpoint  # of gsplat or nerfstudio: a pickle, if only of tensors
    USDC = ".usdc", ".usdc", None, usd_blocks, True
    USDZ = ".usdz", ".usdz", None, partial(usd_blocks, suffix=".usdz"), True


WRITERS = {row.suffix: row for row in SplatFormat if row.write}
# Over HTTP, where no pickle is opened.
HTTP_SUFFIXES = tuple(row.suffix for row in SplatFormat if row.read and row is not SplatFormat.CHECKPOINT)
