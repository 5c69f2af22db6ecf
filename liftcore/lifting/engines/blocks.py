"""A lift in blocks: the job that all workers know, and its first step, W of a few views. Files in, files out.

**Weighing** (`weigh`) reads WEIGHED views and writes a file each, of the codebook E of its regions and its sampled
rays, and one of all of them, of their ``W = A'^T S``, whose rows are splats: a block of splats lies in one place of
it, so that later steps open one file for WEIGHED views. It holds the splats that its views can see, and no others.

What follows on these files are the steps of `lifting.engines.steps`, whose pieces are views or blocks of splats.
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

WEIGHED = 8  # views of a piece: some seconds of work, which is what a worker that dies loses
SELECTED = 1 << 22  # splats beyond which a worker holds only those that its views see: 1 GB as the raster has them
STEP = 1 << 18  # splats that are looked at together for it
SCENE = "scene.safetensors"


@dataclass(frozen=True)
class Job:
    """A lift in blocks, as every worker knows it. Paths lead to the same files for all of them."""

    folder: Path  # where pieces are written
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
    step: int = 0  # of those that are taken several times
    related: bool = False  # whether tuples of masks are needed
    usual_share: float | None = None  # the mean share of mask consensus; None where there is none
    by_region: bool = False  # whether regions are weighted as a whole
    levels_apart: bool = False  # whether regions are compared with those of their own level alone
    delta: float | None = None  # of Huber's loss
    clusters: int = 0  # whose features splats may take
    guarded: bool = False  # whether they do where it explains them

    @property
    def weighings(self) -> int:
        """Pieces of views."""
        return -(-len(self.names) // WEIGHED)

    @property
    def solutions(self) -> int:
        """Pieces of splats."""
        return -(-self.splats // self.rows)

    def view_file(self, number: int) -> Path:
        """What was found of the view of that number, beside its W."""
        return self.folder / f"view-{number:05}.safetensors"

    def weights_file(self, piece: int) -> Path:
        """W of a piece of views."""
        return self.piece_file("weights", piece)

    def views_of(self, piece: int) -> range:
        """The numbers of the views of a piece."""
        return range(WEIGHED * piece, min(WEIGHED * (piece + 1), len(self.names)))

    def piece_file(self, step: str, number: int) -> Path:
        """What a step wrote of a piece."""
        return self.folder / f"{step}-{number:05}.safetensors"

    def solved_file(self, number: int) -> Path:
        """X of a range of splats as it is solved; splats may take other features then."""
        return self.piece_file("solved", number) if self.clusters else self.features_file(number)

    def features_file(self, number: int) -> Path:
        """X of a range of splats."""
        return self.folder / "lift" / features_file(number)

    def columns_file(self, number: int) -> Path:
        """What else is known of these splats."""
        return self.folder / f"columns-{number:05}.safetensors"


class ViewFiles(NamedTuple):
    """What a weighing wrote of a view, beside its W."""

    codebook: ViewCodebook
    sample: SampledRays
    levels: np.ndarray  # [M] i8, as `Geometry` has them
    entries: int  # of its W
    blind: bool  # whether it meets no splat


class WeightBlock(NamedTuple):
    """W of a piece of views: rows of splats, in each the entries of one view after the other's."""

    splats: np.ndarray  # [n] i32 ascending
    starts: np.ndarray  # [n + 1] i64
    region: np.ndarray  # [nnz] i32, counted from the piece's first
    weight: np.ndarray  # [nnz] f32
    evidence_splats: np.ndarray  # [m] i32 ascending
    evidence_starts: np.ndarray  # [m + 1] i64
    evidence: np.ndarray  # [e] f32, of each view that meets the splat


# ---- weighing


@one_thread()
def weigh(job: Job, piece: int, threads: int | None) -> None:
    """Write W, E and sampled rays of a few views; those that lie there already are left as they are.

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
            if not job.weights_file(piece).exists():  # else another worker, with the same piece, was done before
                raise
    for number in job.views_of(piece):
        _entries_file(job, number).unlink(missing_ok=True)


def _weigh_views(job: Job, numbers: list[int], threads: int | None) -> None:
    device = choose_device(job.settings.device)
    packs = packs_at(job.packs, tuple(map(file_version, job.packs)))
    views = LiftViews(job.cameras, pair(packs, job.cameras)[0], job.names, [])
    cameras = [views.camera(number) for number in numbers]
    splats, ids = seen_splats(job, cameras, threads)
    warm_up_lift(job.kernel, device, job.settings)
    raster = open_raster(splats, device, threads)
    waiting = deque[WeightRequest]()

    def requests():
        for number in numbers:
            waiting.append(weight_request(views, number, job.settings, by_rows=job.settings.weighs_rows))
            yield waiting[-1].request

    with closing(raster.iterate_views(requests())) as found:
        for number, view in zip(numbers, found, strict=True):
            asked = waiting.popleft()
            weights = asked.weights(_renumbered(view, ids)).cpu()
            weights.save(_entries_file(job, number))
            _write_view(
                job.view_file(number), weights, asked, replace(view.rows, splats=ids[view.rows.splats.long()])
            )


def _entries_file(job: Job, number: int) -> Path:
    """W of a view, until that of its piece is written."""
    return job.piece_file("entries", number)


def seen_splats(job: Job, cameras: list[Camera], threads: int | None) -> tuple[Splats, Tensor]:
    """The splats that any of the cameras may show, as the raster's own projection decides, and their numbers [n] i32.

    All of them where they are few, and the first alone where none is in sight. Their order stays, so rays meet the
    same splats one after the other as in the whole scene.
    """
    scene = scene_of(job)
    if job.splats <= job.selected:
        return scene, torch.arange(job.splats, dtype=torch.int32)
    params, seen = job.settings.lift_params, np.zeros(job.splats, bool)
    device = choose_device(job.settings.device)
    for first in range(0, job.splats, STEP):
        last = min(first + STEP, job.splats)
        raster = open_raster(_rows(scene, slice(first, last)), device, threads)
        for camera in cameras:
            seen[first:last] |= raster.footprints(camera, params).numpy() > 0
    ids = np.flatnonzero(seen).astype(np.int32)
    ids = ids if ids.size else np.zeros(1, np.int32)
    return _rows(scene, torch.from_numpy(ids).long()), torch.from_numpy(ids)


def write_scene(splats: Splats, path: Path) -> None:
    """Write the geometry of splats for workers to map."""
    tensors = {name: getattr(splats, name) for name in ("means", "quats", "log_scales", "opacity_logits", "beta")}
    tensors["origin"] = torch.tensor(splats.origin, dtype=torch.float64)
    write_tensors(path, {name: tensor.cpu() for name, tensor in tensors.items() if tensor is not None}, {})


def scene_of(job: Job) -> Splats:
    """The geometry of all splats, mapped."""
    path = job.folder / SCENE
    return mapped_scene(path, file_version(path), job.kernel)


def file_version(path: Path) -> tuple[int, int]:
    """What tells a file from one that was in its place before."""
    found = path.stat()
    return found.st_mtime_ns, found.st_ino


@lru_cache(maxsize=1)
def mapped_scene(path: Path, version: tuple[int, int], kernel: Kernel) -> Splats:
    """The geometry of splats that `write_scene` wrote; ``version`` is of the file."""
    found = {name: torch.from_numpy(array) for name, array in map_tensors(path)[0].items()}
    means, quats, log_scales, logits = (found[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
    origin = found["origin"].tolist()
    return Splats(means, quats, log_scales, logits, kernel, beta=found.get("beta"), origin=origin)


def _rows(splats: Splats, rows: slice | Tensor) -> Splats:
    beta = None if splats.beta is None else splats.beta[rows]
    parts = splats.means[rows], splats.quats[rows], splats.log_scales[rows], splats.opacity_logits[rows]
    return Splats(*parts, splats.kernel, beta=beta, origin=splats.origin)


@lru_cache(maxsize=1)
def packs_at(paths: tuple[Path, ...], versions: tuple[tuple[int, int], ...]) -> Views:
    """The views of packs, whose headers are read once a worker; anew where a file has taken another's place."""
    return read_features(*paths)


def _renumbered(view: ViewWeights, ids: Tensor) -> ViewWeights:
    """The same with the scene's numbers of its splats."""
    weights = view.weights
    numbers = ids.to(weights.device)
    own = {name: numbers[getattr(weights, name).long()] for name in ("splats", "evidence_splats")}
    return replace(view, weights=replace(weights, **own))


# A view's file: the codebook and the sampled rays, and how much there is of its W.


def _write_view(path: Path, weights: RegionWeights, asked: WeightRequest, rows: RayRows) -> None:
    readout, tuples = asked.readout, asked.codebook.tuples
    tensors = {f"rays/{name}": getattr(rows, name) for name in ("indptr", "splats", "weights")}
    tensors |= {f"read/{name}": torch.from_numpy(getattr(readout, name)) for name in ("rays", "columns", "shares")}
    tensors |= {"codebook": asked.codebook.rows, "levels": torch.from_numpy(asked.levels)}
    tensors["counts"] = torch.tensor([weights.region.shape[0], weights.evidence.shape[0]])
    write_tensors(path, tensors | ({} if tuples is None else {"tuples": tuples}), {})


def read_view(path: Path) -> ViewFiles:
    """What a weighing wrote of a view, mapped."""
    arrays = map_tensors(path)[0]
    found = {name: torch.from_numpy(array) for name, array in arrays.items()}
    rows = RayRows(**{name: found[f"rays/{name}"] for name in ("indptr", "splats", "weights")})
    readout = Readout(**{name: arrays[f"read/{name}"] for name in ("rays", "columns", "shares")})
    codebook, sample = ViewCodebook(found["codebook"], found.get("tuples")), SampledRays(rows, readout)
    entries, met = arrays["counts"].tolist()
    return ViewFiles(codebook, sample, arrays["levels"], entries, blind=not met)


# The file of a piece of views: their W, put together by splats.


def _write_weights(job: Job, piece: int) -> None:
    parts = [RegionWeights.load(_entries_file(job, number)) for number in job.views_of(piece)]
    bases = np.cumsum([0, *(int(part.offsets[-1]) for part in parts[:-1])]).astype(np.int32)
    splats = _union([part.splats for part in parts], job.splats)
    met = _union([part.evidence_splats for part in parts], job.splats)

    def entries() -> Iterator[SomeRows]:
        for part, base in zip(parts, bases, strict=True):
            values = part.region.numpy() + base, part.weight.numpy()
            yield SomeRows(np.searchsorted(splats, part.splats.numpy()), part.indptr.numpy(), values)

    def evidence() -> Iterator[SomeRows]:
        for part in parts:
            rows = np.searchsorted(met, part.evidence_splats.numpy())
            yield SomeRows(rows, np.arange(rows.size + 1), [part.evidence.numpy()])

    starts, (region, weight) = gather_rows(entries, splats.size, [torch.int32, torch.float32])
    met_starts, (sums,) = gather_rows(evidence, met.size, [torch.float32])
    tensors = {"splats": splats, "starts": starts, "evidence_splats": met, "evidence_starts": met_starts}
    tensors = {name: torch.from_numpy(array) for name, array in tensors.items()}
    write_tensors(job.weights_file(piece), tensors | {"region": region, "weight": weight, "evidence": sums}, {})


def _union(parts: list[Tensor], count: int) -> np.ndarray:
    """[n] i32 ascending, the splats of so many that any of the parts has."""
    found = np.zeros(count, np.bool_)
    for part in parts:
        found[part.numpy()] = True
    return np.flatnonzero(found).astype(np.int32)


def read_weights(job: Job, piece: int) -> WeightBlock:
    """W of a piece of views, mapped."""
    return WeightBlock(**map_tensors(job.weights_file(piece))[0])
