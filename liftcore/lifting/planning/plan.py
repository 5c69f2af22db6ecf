"""The plan of a lift, before the first view: visibility, the choice of views, estimates of memory, warnings."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import Unavailable
from liftcore.lifting.pieces import PIECE_VIEWS, ROWS, SELECTED
from liftcore.lifting.planning.contradictions import contradictions
from liftcore.lifting.planning.views import (
    NOISE_VIEWS,
    Visibility,
    count_covering_views,
    estimate_view_noise,
    view_order,
    visibility,
)
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import CPU, Device
from liftcore.runtime.memory import check_disk, free_memory, lack_of_disk
from liftcore.runtime.one_line import one_line
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.cameras import Camera, Cameras, distortion_warning, intrinsics_advice, intrinsics_factor
from liftcore.scene.compositing import TILE
from liftcore.scene.render_mode import rendering_reason, rendering_warnings
from liftcore.scene.splats import Splats
from liftcore.solve.codebook import LEAST_CHANNELS, TABLE_BYTES
from liftcore.solve.diagnostics import shape_warnings
from liftcore.solve.objects import MOST_REGIONS
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views
from liftcore.values.region_weights import MEMORY_LIMIT
from liftcore.values.settings import LiftSettings
from liftcore.values.views import DENSE_ROWS

FEW_VIEWS = 32  # and fewer are all lifted, whatever view_cosine: estimating the noise would cost what it saves
RAY_SPLATS = 40  # on a ray, about: 29 in the mean of rays of tabletop, 99 of plush (`weights_at`)
MIB, GIB = 2**20, 2**30
LIBRARIES = 450_000_000  # of torch, numba, numpy and the compiled kernels, before anything is read
SCENE_BYTES = 230  # of a splat: in the raster, its order and counts in a view, sums of the solution
RECORD_BYTES = 240  # of a visible splat: projected, with its row of W
TILE_BYTES = 100  # of a splat in a tile: its index in the tile's list, and its weights there
ENTRY_BYTES, ROW_BYTES = 8, 20  # of W: region and weight; a splat's number, row start and total weight
DENSE_BYTES = 27  # of an entry of a dense map: by tiles, and gathered by splat
STEP_BYTES = 12  # of an entry, in the steps between W and X
FACTOR_BYTES = 19  # of an entry there whose factor is in memory
HIT_BYTES = 24  # of a splat on a ray, in the matrix of the least-squares optimum and what it is joined from
CLUSTERING = 320_000_000  # of hdbscan with its dependencies and its sample
SMOOTHING_BYTES = 2_100  # of a splat: the graph while it is built, or with a block of channels
SPARE = 0.9  # of the free memory: 10 % are left to other processes
DEVICE_SPLAT_BYTES = 400  # of a splat on a GPU, with the smallest batches of tiles


def scene_warnings(
    splats: Splats, cameras: Cameras, views: Sequence[Camera], settings: LiftSettings
) -> tuple[str, ...]:
    """Return warnings of splats and cameras, and of the lenses of ``views``."""
    rendering = rendering_warnings(splats.render_mode, settings.compositing.antialiased, splats.kernel)
    factor = intrinsics_factor(views)
    off_centre = (
        () if factor is None else (f"cameras: their centres are off all images': {intrinsics_advice(factor)}",)
    )
    return *splats.warnings, *rendering, *cameras.warnings, *distortion_warning(views), *off_centre


@dataclass(frozen=True)
class Plan:
    """The plan of a lift. Plain values: the same inputs and settings give the same plan."""

    kernel: str
    antialiased: bool  # opacities are compensated for the low-pass
    rendering: str  # the reason of ``antialiased``: a file, a trainer or a setting
    splats: int  # P
    views: tuple[str, ...]  # that will be lifted, in the order of the sums
    left_out: tuple[str, ...]  # of those with features and a camera, by the settings
    available_views: int  # views with features and a camera, also those that the settings leave out
    view_cosine: float | None  # expected, of the views' features to those of all, if the setting chose views
    seen_share: float  # of the splats, that some view can see, before occlusion
    splats_a_view: float  # that a view can see, before occlusion
    channels: int  # F
    dtype: str  # of X, if it can represent the codebooks
    memory_phases: Mapping[str, Mapping[str, int]]  # bytes a part in each phase, about; what a phase frees is gone
    in_files: int  # bytes of W beyond those that stay in memory, about
    device: Device  # of rasterization and solve
    features_room: int | None  # bytes of this machine's memory that X may take today; None for no limit
    machine_warnings: tuple[str, ...]  # of this machine, today
    input_warnings: tuple[str, ...]  # of splats, cameras and features; the diagnostics of the lift have them too

    def __repr__(self) -> str:
        views = f"{len(self.views)} of {self.available_views} views"
        memory = f"{self.memory_bytes / 2**30:.1f} GiB"
        warnings = f"{len(self.warnings)} warnings"
        return one_line(self, f"{self.splats} of {self.kernel}", views, f"{self.channels} channels", memory, warnings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All warnings: of the machine, then of the inputs."""
        return (*self.machine_warnings, *self.input_warnings)

    @property
    def memory(self) -> Mapping[str, int]:
        """Bytes a part at the peak, about: in the phase that takes the most."""
        return max(self.memory_phases.values(), key=lambda parts: sum(parts.values()))

    @property
    def memory_bytes(self) -> int:
        """The estimated peak."""
        return sum(self.memory.values())

    def facts(self) -> dict[str, Any]:
        """Return plain values for the diagnostics, without those that depend on this machine alone."""
        names = "kernel", "antialiased", "rendering", "splats", "seen_share", "splats_a_view", "view_cosine"
        return {name: getattr(self, name) for name in (*names, "channels", "dtype", "memory_bytes")} | {
            "views": len(self.views),
            "views_left_out": len(self.left_out),
            "memory": dict(self.memory),
            "weights_in_files_bytes": self.in_files,
            "device": self.device.kind,
        }

    def summary(self) -> Iterator[str]:
        """Yield three lines for people: the scene and its views, the channels, the memory."""
        kernel = f"{self.kernel}, antialiased: {self.rendering}" if self.antialiased else self.kernel
        visible = f"{self.seen_share:.1%} in some view's field"
        cosine = "" if self.view_cosine is None else f" (features of cosine {self.view_cosine:.3f} to all)"
        yield f"{self.splats} splats ({kernel}), {visible}; {len(self.views)} of {self.available_views} views{cosine}"
        yield f"{self.channels} channels, stored as {self.dtype}"
        files = f", {self.in_files / MIB:.0f} MiB of region weights in files" if self.in_files else ""
        yield f"about {self.memory_bytes / MIB:.0f} MiB at the peak{files}, on {self.device.name}"


@one_thread()
def plan_lift(
    splats: Splats,
    views: LiftViews,
    settings: LiftSettings,
    device: Device,
    threads: int | None = None,
    *,
    in_blocks: bool = False,
    folder: Path | None = None,
    probe: bool = False,
) -> Plan:
    """Plan the lift of the views; the settings' coverage and view_cosine may choose among them.

    Args:
        device: of the lift. With ``auto``, a GPU with too little memory is replaced by the CPU.
        in_blocks: True plans the memory of one worker, and asks this machine for none.
        folder: of the blocks, if it is known.
        probe: True computes W of a few views, to report contradictions of the inputs. A lift in memory does so with
            the views that it begins with.

    Raises:
        Unavailable: the codebooks do not fit memory, or the features neither memory nor disk; or the GPU that
            settings require is too small.
    """
    features = views.features
    names = views.names
    cameras = [views.cameras[name] for name in names]
    visible = visibility(splats, cameras, settings.compositing, threads)
    short = [] if in_blocks else check_device_memory(device, splats.count, settings.device)
    device = CPU if short else device
    raster, contradicting = None, list[str]()
    if probe or _estimates_noise(settings, len(names)):
        raster = open_raster(splats, device, threads)
    selection, expected = _choose_views(raster, views, settings, visible)
    names, visible, cameras = [names[k] for k in selection], visible.of(selection), [cameras[k] for k in selection]
    if probe and raster is not None:  # of the views that a lift uses
        contradicting = contradictions(raster, views.only(names), settings, visible.seen_share)
    entries = _entries(visible, cameras, features, names, settings)
    weights = weight_bytes(visible, entries, settings)
    phases = memory_phases(splats, visible, cameras, features, names, settings, entries)
    free, in_files = None if in_blocks else free_memory(), max(0, weights - MEMORY_LIMIT)
    if in_blocks:  # W by views, W by splats, and X
        disk_warnings = check_room(2 * weights + phases["solve"]["features"], folder) if folder else []
        phases, in_files = worker_phases(phases, weights, visible, settings), 0
    else:
        disk_warnings = check_room(in_files, None)
    lifted, antialiased = set(names), settings.compositing.antialiased
    return Plan(
        kernel=str(splats.kernel),
        antialiased=antialiased,
        rendering=rendering_reason(splats.render_mode, antialiased),
        splats=splats.count,
        views=tuple(names),
        left_out=tuple(name for name in features.views if name not in lifted),
        available_views=len(features),
        view_cosine=expected,
        seen_share=visible.seen_share,
        splats_a_view=visible.splats_a_view,
        channels=features.channels,
        dtype=settings.dtype,
        memory_phases=phases,
        in_files=in_files,
        device=device,
        features_room=features_room(phases, free),
        machine_warnings=(*short, *check_memory(phases, free), *disk_warnings),
        input_warnings=(
            *scene_warnings(splats, views.cameras, cameras, settings),
            *shape_warnings(features, cameras),
            *contradicting,
        ),
    )


def _estimates_noise(settings: LiftSettings, views: int) -> bool:
    """Return True if the settings choose among ``views`` views by the noise of features."""
    return bool(settings.view_cosine) and views > FEW_VIEWS


def _choose_views(
    raster: Raster | None, views: LiftViews, settings: LiftSettings, visible: Visibility
) -> tuple[list[int], float | None]:
    """Choose the views to lift, ascending; return their expected cosine too, if noise was estimated.

    The first views of one order that satisfy both: each splat is seen ``coverage`` times, and ``view_cosine`` is
    reached. If the estimate could save no more views than it needs, it is skipped and all views are chosen.
    """
    all_views = list(range(visible.areas.shape[0]))
    if not settings.coverage and not _estimates_noise(settings, len(all_views)):
        return all_views, None
    order = list(view_order(visible))
    least = count_covering_views(visible, order, settings.coverage)
    if not settings.view_cosine:
        return sorted(order[:least]), None
    if raster is None or len(all_views) <= max(FEW_VIEWS, least + NOISE_VIEWS):
        return all_views, None
    estimate = estimate_view_noise(raster, views, settings, visible)
    count, expected = estimate.views_for(settings.view_cosine, order, least)
    return sorted(order[:count]), expected


def weight_bytes(visible: Visibility, entries: np.ndarray, settings: LiftSettings) -> int:
    """Estimate the bytes of W of all views from the number of entries of each [V]."""
    entry_bytes = ENTRY_BYTES + 4 * settings.robust  # with its factor
    return int(ROW_BYTES * _splat_counts(visible).sum() + entry_bytes * entries.sum())


def _splat_counts(visible: Visibility) -> np.ndarray:
    """Estimate the number of visible splats of each view, [V] f64."""
    return visible.in_view.sum(axis=1) / visible.areas.shape[1] * visible.splats


def _entries(
    visible: Visibility, cameras: Sequence[Camera], features: Views, names: Sequence[str], settings: LiftSettings
) -> np.ndarray:
    """Estimate the entries of W of each view, [V] f64.

    A splat has one region or four cells a tile and level; a ray of a dense map has RAY_SPLATS splats.
    """
    counts = _splat_counts(visible) * _tiles(visible)
    for number, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        if _is_dense(features, name):
            counts[number] = RAY_SPLATS * camera.width * camera.height / settings.stride**2
    return counts * [_parts_a_tile(features, name, settings) for name in names]


def _is_dense(features: Views, view: str) -> bool:
    return math.prod(_codebook(features, view)[:-1]) > DENSE_ROWS


def memory_phases(
    splats: Splats,
    visible: Visibility,
    cameras: Sequence[Camera],
    features: Views,
    names: Sequence[str],
    settings: LiftSettings,
    entries: np.ndarray,
) -> dict[str, dict[str, int]]:
    """Estimate the bytes of each part of a lift in each of its phases.

    Args:
        entries: [V], of W of each view.
    """
    inputs = sum(t.nbytes for t in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits))
    largest, channels = max(camera.width * camera.height for camera in cameras), features.channels
    weights = min(weight_bytes(visible, entries, settings), MEMORY_LIMIT)
    view = int(_splat_counts(visible).max(initial=0) * (RECORD_BYTES + TILE_BYTES * _tiles(visible))) + 16 * largest
    dense = (int(count) for count, name in zip(entries, names, strict=True) if _is_dense(features, name))
    books = sum(math.prod(_codebook(features, name)) for name in names)
    regions, size = books // max(channels, 1), 2 if settings.dtype == "float16" else 4
    scene = {
        "libraries": LIBRARIES,
        "splats": inputs + splats.count * SCENE_BYTES,
        "codebooks": size * books + min(8 * books, 2 * max(TABLE_BYTES, 4 * LEAST_CHANNELS * regions)),
        "weights": weights,
    }
    steps, solving = weights, [0]  # W by views is copied by splats
    if settings.robust or settings.finds_objects(any(map(features.is_regions, names))):
        factors = min(float(entries.sum()), MEMORY_LIMIT / ENTRY_BYTES)
        nodes = min(MOST_REGIONS, regions)
        steps = max(steps, int(STEP_BYTES * entries.sum() + FACTOR_BYTES * factors) + 8 * nodes**2)
    if settings.reference_channels:
        hits = float(visible.areas.sum(dtype=np.float64)) / visible.areas.shape[1] * visible.splats
        solving.append(int(HIT_BYTES * hits / settings.stride**2) + view)
    if settings.smoothness:
        solving.append(SMOOTHING_BYTES * splats.count)
    if settings.aggregation:
        solving.append(CLUSTERING + view)
    return {
        # Two views are in work, or one and what is made of it; of dense ones one.
        "geometry": scene | {"view": 2 * view + DENSE_BYTES * max(dense, default=0)},
        "steps": scene | {"steps": steps},
        "solve": scene | {"features": splats.count * channels * size, "work": max(solving)},
    }


def worker_phases(
    phases: Mapping[str, Mapping[str, int]], weights: int, visible: Visibility, settings: LiftSettings
) -> dict[str, dict[str, int]]:
    """Estimate the bytes of each part in one worker of a lift in blocks, from those in memory and those of all W."""
    block, views = min(1.0, ROWS / visible.splats), min(1.0, PIECE_VIEWS / len(visible.areas))
    shares = {"splats": min(1.0, max(SELECTED, visible.splats_a_view) / visible.splats), "steps": max(views, block)}
    if not (settings.smoothness or settings.aggregation):  # which the calling process does on all of X
        shares["features"] = block
    scaled = dict[str, dict[str, int]]()
    for phase, parts in phases.items():
        scaled[phase] = {name: int(size * shares.get(name, 1.0)) for name, size in parts.items()}
        scaled[phase]["weights"] = min(int((views if phase == "geometry" else block) * weights), MEMORY_LIMIT)
    return scaled


def _tiles(visible: Visibility) -> float:
    """Estimate the mean number of tiles that a visible splat touches."""
    sides = np.sqrt(visible.areas[visible.in_view], dtype=np.float64)
    return float(np.mean((sides / TILE + 1.0) ** 2)) if sides.size else 1.0


def _parts_a_tile(features: Views, view: str, settings: LiftSettings) -> int:
    if not features.is_regions(view):
        return 4  # of bilinear reading
    return 1 if isinstance(settings.levels, int) else _levels(features, view)


def _levels(features: Views, view: str) -> int:
    """Return the number of levels of a view's region map; 1 for a grid."""
    return features.shapes(view)["labels"][0] if features.is_regions(view) else 1


def _codebook(features: Views, view: str) -> tuple[int, ...]:
    """Return the shape of the view's codebook, or of its grid."""
    return next(shape for part, shape in features.shapes(view).items() if part != "labels")


def check_device_memory(device: Device, splats: int, requested: str) -> list[str]:
    """Return a warning if the GPU's memory is too small for the scene and ``auto`` may use the CPU, else none.

    Raises:
        Unavailable: it is too small, and ``cuda`` was requested.
    """
    free = device.free_bytes()
    required_bytes = splats * DEVICE_SPLAT_BYTES
    if free is None or required_bytes <= free:
        return []
    required, available = f"{required_bytes / GIB:.1f} GiB", f"{free / GIB:.1f} GiB"
    if requested == "cuda":
        raise Unavailable(
            "device", expected=f"{required} of free memory on {device.name}", got=available,
            hint="end other programs there, lift fewer splats, smaller images or fewer channels, or use device=cpu",
        )  # fmt: skip
    return [f"{device.name} has {available} free and the lift needs {required}: the lift runs on the CPU"]


def features_room(phases: Mapping[str, Mapping[str, int]], free: int | None) -> int | None:
    """Return the bytes that X may take beside the rest, beyond which it is a mapped file; None for no limit."""
    if free is None:
        return None
    return max(0, int(SPARE * free) - _rest([parts for parts in phases.values() if "features" in parts]))


def _rest(phases: Iterable[Mapping[str, int]]) -> int:
    """Return the bytes of all parts but X, at the peak of some phases."""
    return max(sum(parts.values()) - parts.get("features", 0) for parts in phases)


def check_memory(phases: Mapping[str, Mapping[str, int]], free: int | None) -> list[str]:
    """Return warnings about the free memory, if it is too small.

    Raises:
        Unavailable: even the codebooks do not fit, or the features fit neither memory nor disk.
    """
    if free is None:
        return []
    capacity, solve = features_room(phases, free), phases["solve"]
    available, rest = f"{free / GIB:.1f} GiB", _rest(phases.values())
    hint = "try fewer views (coverage) or fewer channels"
    if solve["codebooks"] > free:
        got = f"{solve['codebooks'] / GIB:.1f} GiB for codebooks"
        raise Unavailable("memory", expected=f"at most the {available} that are free", got=got, hint=hint)
    warnings = []
    if capacity is not None and solve["features"] > capacity:
        check_disk(solve["features"], "features")
        size = f"{solve['features'] / GIB:.1f} GiB"
        warnings.append(
            f"the features, {size}, do not fit into the {available} that are free: they go through a mapped file"
        )
    if rest > SPARE * free:
        warnings.append(f"the rest of the lift may take {rest / GIB:.1f} GiB and {available} are free: {hint}")
    return warnings


def check_room(size: int, folder: Path | None) -> list[str]:
    """Return a warning if there is no room for ``size`` bytes of W and X in files, else none.

    Args:
        folder: of a lift in blocks; None: the temporary folder.
    """
    got = lack_of_disk(size, folder) if size else ""
    if not got:
        return []
    remedy = "give a checkpoint folder with more room"
    if folder is None:
        remedy = "set TMPDIR to a folder with more room on a disk, or try fewer views (coverage)"
    place = folder or tempfile.gettempdir()
    return [f"files of about {size / GIB:.1f} GiB go to {place}, and there is {got}: {remedy}"]
