"""A lift in blocks: its pieces in files, which all workers read, and its first steps, W of views and of blocks.

**Weighing** (`weigh`) reads PIECE_VIEWS views. For each it writes a file of the codebook E of its regions and its
sampled rays, and for all of them one file of ``W = A'^T S``. The rows of W are splats: a block of splats is
contiguous, so that later steps open one file for PIECE_VIEWS views. A worker loads only the splats that these views
can see.

`gather` writes W of a block of splats in all views. Later steps are those of every lift (`lifting.steps`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.io.safetensors_file import map_tensors, tensor_bytes, write_tensors
from liftcore.lifting.geometry import weigh_views
from liftcore.lifting.pieces import PIECE_VIEWS, Pieces, Shape, SomeRows, gather_rows, part_of, values_of
from liftcore.lifting.steps import Saved, row_arrays, saved_as, weights_of
from liftcore.raster import open_raster
from liftcore.raster.base import RayRows
from liftcore.runtime.device import choose_device
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.rays import Readout, SampledRays
from liftcore.solve.sums import PieceSums, pack_sums, unpack_sums
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views, pair, read_features

STEP = 1 << 18  # splats that are tested together for it
SCENE = "scene.safetensors"


@dataclass(frozen=True, kw_only=True)
class PiecesInFiles(Pieces):
    """The pieces of a lift in blocks, as every worker receives them: files, whose paths are valid on all workers."""

    folder: Path  # of the pieces
    packs: tuple[Path, ...]  # of the features
    cameras: Cameras
    kernel: Kernel
    selected: int  # splats of scenes that workers load as a whole

    @property
    def means(self) -> Tensor:
        return splats_of(self).means

    @property
    def codebook(self) -> Codebook:
        paths = tuple(map(self.view_file, range(len(self.names))))
        return _codebook(paths, file_version(self.piece_file("regions", None)))

    def view_file(self, number: int) -> Path:
        """Return the file of a view's codebook and sampled rays; ``number`` is of the view."""
        return self.piece_file("view", number)

    def views_of(self, piece: int) -> range:
        return range(PIECE_VIEWS * piece, min(PIECE_VIEWS * (piece + 1), len(self.names)))

    def piece_file(self, step: str, number: int | None) -> Path:
        """Return the file of a step of that piece, or of a table."""
        return self.folder / (f"{step}.safetensors" if number is None else f"{step}-{number:05}.safetensors")

    @property
    def features_file(self) -> Path:
        """The file of X, of row after row of all splats; each block has its place in it."""
        return self.folder / "features"

    def has(self, step: str, number: int) -> bool:
        return self.piece_file(step, number).exists()

    def load(self, step: str, number: int | None = None) -> dict[str, Any]:
        path = self.piece_file(step, number)
        return _table(path, file_version(path)) if number is None else map_tensors(path)[0]

    def save(
        self,
        step: str,
        number: int | None,
        arrays: dict[str, Any],
        sums: Iterable[PieceSums] = (),
        shape: Shape | None = None,
    ) -> None:
        tensors = pack_sums(parts) if (parts := list(sums)) else {}
        for name, part in arrays.items():
            tensors[name] = part if isinstance(part, Tensor) else torch.from_numpy(part)
        write_tensors(self.piece_file(step, number), tensors, {})

    def sums(self, step: str) -> Iterator[PieceSums]:
        return (part for number in range(self.splat_pieces) for part in unpack_sums(self.load(step, number)))

    def drop(self, *steps: str) -> None:
        """Keep the files, from which the lift resumes."""

    def writable(self, array: np.ndarray) -> Tensor:
        values = torch.from_numpy(array)
        return values_of(values.shape[0], values.dtype).copy_(values)

    def new_features(self, piece: int) -> Tensor:
        first, last = self.bounds(piece)
        return torch.zeros(last - first, self.channels, dtype=self.dtype)

    def save_features(self, piece: int, X: Tensor) -> None:
        handle = os.open(self.features_file, os.O_WRONLY | os.O_CREAT, 0o644)
        with os.fdopen(handle, "wb") as file:
            file.seek(self.bounds(piece)[0] * X.shape[1] * X.itemsize)
            file.write(tensor_bytes(X))
            file.flush()
            os.fsync(file.fileno())  # the block counts as done once its columns are written

    def features(self) -> Tensor:
        size = self.splats * self.channels
        return torch.from_file(str(self.features_file), size=size, dtype=self.dtype).view(self.splats, self.channels)

    def samples(self) -> list[SampledRays]:
        return [read_view(self.view_file(number))[1] for number in range(len(self.names))]


@lru_cache(maxsize=4)
def _table(path: Path, _version: tuple[int, int]) -> dict[str, np.ndarray]:
    return map_tensors(path)[0]


@lru_cache(maxsize=1)
def _codebook(paths: tuple[Path, ...], _version: tuple[int, int]) -> Codebook:
    return Codebook([read_view(path)[0] for path in paths])


def forget_files() -> None:
    """Unmap the files of a lift: the disk frees the space of a deleted file only when nothing maps it."""
    for cache in (_table, _codebook, mapped_scene, packs_at):
        cache.cache_clear()


# ---- weighing


@one_thread()
def weigh(pieces: PiecesInFiles, piece: int, threads: int | None) -> None:
    """Write W, E and sampled rays of a few views, unless they are there.

    Raises:
        InvalidFeatures: a view is malformed.
    """
    if pieces.has("weights", piece):
        return
    packs, numbers = packs_at(pieces.packs, tuple(map(file_version, pieces.packs))), pieces.views_of(piece)
    views = LiftViews(pieces.cameras, pair(packs, pieces.cameras)[0], pieces.names, [])
    splats, ids = visible_splats(pieces, [views.camera(number) for number in numbers], threads)
    arguments = (
        open_raster(splats, choose_device(pieces.settings.device), threads),
        splats.count,
        views,
        pieces.settings,
    )
    by_rows = pieces.settings.weighs_rows
    geometry = weigh_views(*arguments, silent, by_rows=by_rows, threads=threads, numbers=numbers)
    for number, view, sample in zip(numbers, geometry.codebook.views, geometry.samples, strict=True):
        rows = replace(sample.rows, splats=ids[sample.rows.splats.long()])
        _write_view(pieces.view_file(number), view, replace(sample, rows=rows))
    W = geometry.weights
    has_row = torch.nonzero(W.indptr.diff())[:, 0]
    arrays = {
        "splats": ids[has_row],
        "starts": torch.cat([W.indptr[has_row], W.indptr[-1:]]),
        "region": W.region,
        "weight": W.weight,
        "hit_splats": ids[W.total_weight_splats.long()],
        "total_weight": W.total_weight,
        "offsets": W.offsets,
        "levels": geometry.levels,
        "blind": np.array([name in geometry.blind for name in W.views]),
    }
    pieces.save("weights", piece, arrays)


def visible_splats(pieces: PiecesInFiles, cameras: list[Camera], threads: int | None) -> tuple[Splats, Tensor]:
    """Select the splats that the raster's projection puts into any of the images, with their numbers [n] i32.

    All splats where they are few; the first one alone where none is visible. The order stays, so that rays meet the
    same splats in the same order as in the full scene.
    """
    scene = splats_of(pieces)
    if pieces.splats <= pieces.selected:
        return scene, torch.arange(pieces.splats, dtype=torch.int32)
    params, visible = pieces.settings.compositing, np.zeros(pieces.splats, bool)
    device = choose_device(pieces.settings.device)
    for first in range(0, pieces.splats, STEP):
        last = min(first + STEP, pieces.splats)
        raster = open_raster(scene[first:last], device, threads)
        for camera in cameras:
            visible[first:last] |= raster.footprints(camera, params).numpy() > 0
    ids = np.flatnonzero(visible).astype(np.int32)
    ids = ids if ids.size else np.zeros(1, np.int32)
    return scene[ids], torch.from_numpy(ids)


def write_scene(splats: Splats, path: Path) -> None:
    """Write the geometry of splats as a file that workers map."""
    tensors = {name: getattr(splats, name) for name in ("means", "quats", "log_scales", "opacity_logits", "beta")}
    tensors["origin"] = torch.tensor(splats.origin, dtype=torch.float64)
    write_tensors(path, {name: tensor.cpu() for name, tensor in tensors.items() if tensor is not None}, {})


def splats_of(pieces: PiecesInFiles) -> Splats:
    """Map the geometry of all splats."""
    path = pieces.folder / SCENE
    return mapped_scene(path, file_version(path), pieces.kernel)


def file_version(path: Path) -> tuple[int, int]:
    """Return a version of the file, which differs after the file is replaced: modification time [ns] and inode."""
    status = path.stat()
    return status.st_mtime_ns, status.st_ino


@lru_cache(maxsize=1)
def mapped_scene(path: Path, version: tuple[int, int], kernel: Kernel) -> Splats:
    """Map the geometry of splats that `write_scene` wrote; ``version`` is of the file."""
    tensors = {name: torch.from_numpy(array) for name, array in map_tensors(path)[0].items()}
    means, quats, log_scales, logits = (tensors[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
    origin = tensors["origin"].tolist()
    return Splats(means, quats, log_scales, logits, kernel, beta=tensors.get("beta"), origin=origin)


@lru_cache(maxsize=1)
def packs_at(paths: tuple[Path, ...], versions: tuple[tuple[int, int], ...]) -> Views:
    """Open packs; headers are read once a worker, and again after a file is replaced."""
    return read_features(*paths)


# A view's file: the codebook and the sampled rays.


def _write_view(path: Path, view: ViewCodebook, sample: SampledRays) -> None:
    readout = sample.readout
    tensors = {f"rays/{name}": getattr(sample.rows, name) for name in ("indptr", "splats", "weights")}
    tensors |= {f"read/{name}": torch.from_numpy(getattr(readout, name)) for name in ("rays", "columns", "shares")}
    tensors |= {"codebook": view.rows} | ({} if view.tuples is None else {"tuples": view.tuples})
    write_tensors(path, tensors, {})


def read_view(path: Path) -> tuple[ViewCodebook, SampledRays]:
    """Map the file of a view."""
    arrays = map_tensors(path)[0]
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    rows = RayRows(**{name: tensors[f"rays/{name}"] for name in ("indptr", "splats", "weights")})
    readout = Readout(**{name: arrays[f"read/{name}"] for name in ("rays", "columns", "shares")})
    return ViewCodebook(tensors["codebook"], tensors.get("tuples")), SampledRays(rows, readout)


# ---- W of blocks of splats


def _weight_rows(pieces: PiecesInFiles, ends: tuple[int, int]) -> Iterator[SomeRows]:
    """Iterate over the rows of W of a block in each piece of views, with one file open at a time."""
    offsets = pieces.load("regions")["offsets"]
    for piece in range(pieces.view_pieces):
        arrays, base = pieces.load("weights", piece), offsets[pieces.views_of(piece).start]
        yield part_of(arrays["splats"], arrays["starts"], (arrays["region"], arrays["weight"]), ends, base)


def _total_weight(pieces: PiecesInFiles, ends: tuple[int, int]) -> Tensor:
    """Sum the total weight of a block [n] f32 over pieces of views, in their order."""
    sums = np.zeros(ends[1] - ends[0])
    for piece in range(pieces.view_pieces):
        arrays = pieces.load("weights", piece)
        part = slice(*np.searchsorted(arrays["hit_splats"], ends))
        sums[arrays["hit_splats"][part] - ends[0]] += arrays["total_weight"][part]
    return torch.from_numpy(sums).float()


@saved_as("rows")
def gather(pieces: PiecesInFiles, piece: int, threads: int | None) -> Saved:
    """Save W of a block of splats in all views, its sums and total weight."""
    ends = first, last = pieces.bounds(piece)

    def parts(begin: int, end: int) -> Iterator[SomeRows]:
        return _weight_rows(pieces, (first + begin, first + end))

    starts, values = gather_rows(parts, last - first, (torch.int32, torch.float32), threads)
    W = weights_of(starts, values[0], values[1], pieces.load("regions")["offsets"])
    return row_arrays(pieces, W, pieces.means[first:last], _total_weight(pieces, ends), threads)
