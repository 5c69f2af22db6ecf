"""A lift in blocks: the job that all workers receive, and its first step, W of a few views. All in files.

**Weighing** (`weigh`) reads PIECE_VIEWS views. For each it writes a file of the codebook E of its regions and its
sampled rays, and for all of them one file of ``W = A'^T S``. The rows of W are splats: a block of splats is
contiguous, so that later steps open one file for PIECE_VIEWS views. A worker loads only the splats that these views
can see.

The later steps, `lifting.engines.steps`, read these files; their pieces are views or blocks of splats.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidInput
from liftcore.io.safetensors_file import map_tensors, write_tensors
from liftcore.io.shards import ROWS, features_file
from liftcore.lifting.geometry import WeightRequest, weight_request
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.raster import open_raster
from liftcore.raster.base import RayRows, ViewWeights
from liftcore.runtime.device import choose_device
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.solve.codebook import ViewCodebook
from liftcore.solve.rays import Readout, SampledRays
from liftcore.solve.rows import SomeRows, gather_rows
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views, pair, read_features
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import LiftSettings

PIECE_VIEWS = 8  # some seconds of work, which is what is lost with a worker
SELECTED = 1 << 22  # splats beyond which a worker loads only those that its views see: 1 GB in the raster
STEP = 1 << 18  # splats that are tested together for it
SCENE = "scene.safetensors"


@dataclass(frozen=True)
class Job:
    """A lift in blocks, as every worker receives it. Paths are valid on all workers."""

    folder: Path  # of the pieces
    packs: tuple[Path, ...]  # of the features
    cameras: Cameras
    names: tuple[str, ...]  # of the views, in the order of the sums
    settings: LiftSettings
    kernel: Kernel
    splats: int  # P
    channels: int  # F
    dtype: torch.dtype = torch.float16  # of X
    selected: int = SELECTED
    rows: int = ROWS  # of a block of splats: pieces of sums, and whole pages of X
    step: int = 0  # of steps that run several times
    related: bool = False  # True if tuples of masks are needed
    usual_share: float | None = None  # the mean share of mask consensus; None where there is none
    by_region: bool = False  # True if each region has one weight
    levels_apart: bool = False  # True if regions are compared with those of their own level alone

    @property
    def view_pieces(self) -> int:
        """Pieces of views."""
        return -(-len(self.names) // PIECE_VIEWS)

    @property
    def splat_pieces(self) -> int:
        """Pieces of splats."""
        return -(-self.splats // self.rows)

    def view_file(self, number: int) -> Path:
        """Return the file of a view's codebook and sampled rays; ``number`` is of the view."""
        return self.folder / f"view-{number:05}.safetensors"

    def weights_file(self, piece: int) -> Path:
        """Return the file of W of a piece of views."""
        return self.piece_file("weights", piece)

    def views_of(self, piece: int) -> range:
        """Return the numbers of the views of a piece."""
        return range(PIECE_VIEWS * piece, min(PIECE_VIEWS * (piece + 1), len(self.names)))

    def piece_file(self, step: str, number: int) -> Path:
        """Return the file of a step of that piece."""
        return self.folder / f"{step}-{number:05}.safetensors"

    def features_file(self, number: int) -> Path:
        """Return the file of X of a block of splats."""
        return self.folder / "lift" / features_file(number)

    def columns_file(self, number: int) -> Path:
        """Return the file of the other columns of these splats."""
        return self.folder / f"columns-{number:05}.safetensors"


class ViewFiles(NamedTuple):
    """The file of a view: its codebook and sampled rays; W is in the file of its piece."""

    codebook: ViewCodebook
    sample: SampledRays
    levels: np.ndarray  # [M] i8, as `Geometry` has them
    entries: int  # of its W
    blind: bool  # True if its rays hit no splat


class WeightBlock(NamedTuple):
    """W of a piece of views: a row a splat, with the entries of its views in order."""

    splats: np.ndarray  # [n] i32 ascending
    starts: np.ndarray  # [n + 1] i64
    region: np.ndarray  # [nnz] i32, counted from the piece's first
    weight: np.ndarray  # [nnz] f32
    total_weight_splats: np.ndarray  # [m] i32 ascending
    total_weight_starts: np.ndarray  # [m + 1] i64
    total_weight: np.ndarray  # [e] f32, of each view that sees the splat


# ---- weighing


@one_thread()
def weigh(job: Job, piece: int, threads: int | None) -> None:
    """Write W, E and sampled rays of a few views; existing files stay.

    Raises:
        InvalidFeatures: a view is malformed.
    """
    if not job.weights_file(piece).exists():
        numbers = [number for number in job.views_of(piece) if not job.view_file(number).exists()]
        if numbers:
            _weigh_views(job, numbers, threads)
        try:
            _write_weights(job, piece)
        except InvalidInput:
            if not job.weights_file(piece).exists():  # else another worker has finished the same piece
                raise
    for number in job.views_of(piece):
        _entries_file(job, number).unlink(missing_ok=True)


def _weigh_views(job: Job, numbers: list[int], threads: int | None) -> None:
    device = choose_device(job.settings.device)
    packs = packs_at(job.packs, tuple(map(file_version, job.packs)))
    views = LiftViews(job.cameras, pair(packs, job.cameras)[0], job.names, [])
    cameras = [views.camera(number) for number in numbers]
    splats, ids = visible_splats(job, cameras, threads)
    warm_up_lift(job.kernel, device, job.settings)
    raster = open_raster(splats, device, threads)
    waiting = deque[WeightRequest]()

    def requests():
        for number in numbers:
            waiting.append(weight_request(views, number, job.settings, by_rows=job.settings.weighs_rows))
            yield waiting[-1].request

    with closing(raster.iterate_views(requests())) as answers:
        for number, view in zip(numbers, answers, strict=True):
            request = waiting.popleft()
            weights = request.weights(_renumbered(view, ids)).cpu()
            weights.save(_entries_file(job, number))
            _write_view(
                job.view_file(number), weights, request, replace(view.rows, splats=ids[view.rows.splats.long()])
            )


def _entries_file(job: Job, number: int) -> Path:
    """Return the file of W of a view, which exists until W of its piece is written."""
    return job.piece_file("entries", number)


def visible_splats(job: Job, cameras: list[Camera], threads: int | None) -> tuple[Splats, Tensor]:
    """Select the splats that the raster's projection puts into any of the images, with their numbers [n] i32.

    All splats where they are few; the first one alone where none is visible. The order stays, so that rays meet the
    same splats in the same order as in the full scene.
    """
    scene = scene_of(job)
    if job.splats <= job.selected:
        return scene, torch.arange(job.splats, dtype=torch.int32)
    params, visible = job.settings.compositing, np.zeros(job.splats, bool)
    device = choose_device(job.settings.device)
    for first in range(0, job.splats, STEP):
        last = min(first + STEP, job.splats)
        raster = open_raster(_rows(scene, slice(first, last)), device, threads)
        for camera in cameras:
            visible[first:last] |= raster.footprints(camera, params).numpy() > 0
    ids = np.flatnonzero(visible).astype(np.int32)
    ids = ids if ids.size else np.zeros(1, np.int32)
    return _rows(scene, torch.from_numpy(ids).long()), torch.from_numpy(ids)


def write_scene(splats: Splats, path: Path) -> None:
    """Write the geometry of splats as a file that workers map."""
    tensors = {name: getattr(splats, name) for name in ("means", "quats", "log_scales", "opacity_logits", "beta")}
    tensors["origin"] = torch.tensor(splats.origin, dtype=torch.float64)
    write_tensors(path, {name: tensor.cpu() for name, tensor in tensors.items() if tensor is not None}, {})


def scene_of(job: Job) -> Splats:
    """Map the geometry of all splats."""
    path = job.folder / SCENE
    return mapped_scene(path, file_version(path), job.kernel)


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


def _rows(splats: Splats, rows: slice | Tensor) -> Splats:
    beta = None if splats.beta is None else splats.beta[rows]
    parts = splats.means[rows], splats.quats[rows], splats.log_scales[rows], splats.opacity_logits[rows]
    return Splats(*parts, splats.kernel, beta=beta, origin=splats.origin)


@lru_cache(maxsize=1)
def packs_at(paths: tuple[Path, ...], versions: tuple[tuple[int, int], ...]) -> Views:
    """Open packs; headers are read once a worker, and again after a file is replaced."""
    return read_features(*paths)


def _renumbered(view: ViewWeights, ids: Tensor) -> ViewWeights:
    """Replace the numbers of a view's splats by those of the scene."""
    weights = view.weights
    numbers = ids.to(weights.device)
    scene_numbers = {name: numbers[getattr(weights, name).long()] for name in ("splats", "total_weight_splats")}
    return replace(view, weights=replace(weights, **scene_numbers))


# A view's file: the codebook, the sampled rays, and the number of entries of its W.


def _write_view(path: Path, weights: RegionWeights, request: WeightRequest, rows: RayRows) -> None:
    readout, tuples = request.readout, request.codebook.tuples
    tensors = {f"rays/{name}": getattr(rows, name) for name in ("indptr", "splats", "weights")}
    tensors |= {f"read/{name}": torch.from_numpy(getattr(readout, name)) for name in ("rays", "columns", "shares")}
    tensors |= {"codebook": request.codebook.rows, "levels": torch.from_numpy(request.levels)}
    tensors["counts"] = torch.tensor([weights.region.shape[0], weights.total_weight.shape[0]])
    write_tensors(path, tensors | ({} if tuples is None else {"tuples": tuples}), {})


def read_view(path: Path) -> ViewFiles:
    """Map the file of a view."""
    arrays = map_tensors(path)[0]
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    rows = RayRows(**{name: tensors[f"rays/{name}"] for name in ("indptr", "splats", "weights")})
    readout = Readout(**{name: arrays[f"read/{name}"] for name in ("rays", "columns", "shares")})
    codebook, sample = ViewCodebook(tensors["codebook"], tensors.get("tuples")), SampledRays(rows, readout)
    entries, hits = arrays["counts"].tolist()
    return ViewFiles(codebook, sample, arrays["levels"], entries, blind=not hits)


# The file of a piece of views: their W, gathered by splats.


def _write_weights(job: Job, piece: int) -> None:
    parts = [RegionWeights.load(_entries_file(job, number)) for number in job.views_of(piece)]
    bases = np.cumsum([0, *(int(part.offsets[-1]) for part in parts[:-1])]).astype(np.int32)
    splats = _union([part.splats for part in parts], job.splats)
    hit_splats = _union([part.total_weight_splats for part in parts], job.splats)

    def entries() -> Iterator[SomeRows]:
        for part, base in zip(parts, bases, strict=True):
            values = part.region.numpy() + base, part.weight.numpy()
            yield SomeRows(np.searchsorted(splats, part.splats.numpy()), part.indptr.numpy(), values)

    def total_weight() -> Iterator[SomeRows]:
        for part in parts:
            rows = np.searchsorted(hit_splats, part.total_weight_splats.numpy())
            yield SomeRows(rows, np.arange(rows.size + 1), [part.total_weight.numpy()])

    starts, (region, weight) = gather_rows(entries, splats.size, [torch.int32, torch.float32])
    total_weight_starts, (sums,) = gather_rows(total_weight, hit_splats.size, [torch.float32])
    tensors = {
        "splats": splats,
        "starts": starts,
        "total_weight_splats": hit_splats,
        "total_weight_starts": total_weight_starts,
    }
    tensors = {name: torch.from_numpy(array) for name, array in tensors.items()}
    write_tensors(job.weights_file(piece), tensors | {"region": region, "weight": weight, "total_weight": sums}, {})


def _union(parts: list[Tensor], count: int) -> np.ndarray:
    """Return [n] i32 ascending: the splats, of ``count``, that any of the parts has."""
    present = np.zeros(count, np.bool_)
    for part in parts:
        present[part.numpy()] = True
    return np.flatnonzero(present).astype(np.int32)


def read_weights(job: Job, piece: int) -> WeightBlock:
    """Map W of a piece of views."""
    return WeightBlock(**map_tensors(job.weights_file(piece))[0])
