"""The plan of a lift: what is visible, which views it takes, and a bound of its memory, before the first view."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from liftcore.errors import Unavailable
from liftcore.lifting.geometry import weigh_views
from liftcore.lifting.planning.contradictions import contradictions
from liftcore.lifting.planning.views import (
    PILOT_VIEWS,
    WELL_COVERED,
    Visibility,
    estimate_view_noise,
    spare_views,
    view_order,
    views_to_show,
    visibility,
)
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import CPU, Device
from liftcore.runtime.memory import check_disk, free_memory, lack_of_disk
from liftcore.runtime.one_line import one_line
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Camera, Cameras, distortion_warning
from liftcore.scene.compositing import TILE
from liftcore.scene.render_mode import rendering_reason, rendering_warnings
from liftcore.scene.splats import Splats
from liftcore.solve.codebook import LEAST_CHANNELS, TABLE_BYTES
from liftcore.solve.consensus import BLOCK_ENTRIES
from liftcore.solve.diagnostics import shape_warnings
from liftcore.solve.rays import sample_pixels
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views
from liftcore.values.region_weights import MEMORY_LIMIT
from liftcore.values.settings import LiftSettings
from liftcore.values.views import DENSE_ROWS

FEW_VIEWS = 32  # and below, view_cosine takes all: a pilot would cost what it saves
TIMED_VIEWS = 32  # and more have one of them timed: it costs a part of what it tells
TRACED_RAYS = 1_000  # of a view of a dense map, that tell how many splats a ray meets
SHOWN_VIEWS = 6  # names in a line for people
MIB, GIB = 2**20, 2**30
LIBRARIES = 450_000_000  # of torch, numba, numpy and the compiled kernels, before anything is read
SCENE_BYTES = 230  # of a splat: as the raster has it, its order and counts in a view, sums of the solution
RECORD_BYTES = 240  # of a splat that a view shows: projected, with its row of W
TILE_BYTES = 100  # of a splat in a tile: its place in the tile's list, and what the tile found of it
ENTRY_BYTES, ROW_BYTES = 8, 20  # of W: region and weight; a splat's number, row start and evidence
DENSE_BYTES = 27  # of an entry of a dense map as it is found: from tiles, and gathered by splat
JUDGED_BYTES = 12  # of an entry: factors, and the products and squares that they are made of
CONSENSUS_BYTES = 10  # of an entry: what it gets, of how many views, whether it belongs; the tuple of its view
BLOCK_BYTES = 9  # of an entry that lies by region
CG_VECTORS, CG_CHANNELS = 14, 32  # [P, 32] f32 of conjugate gradients, with the images of a view
CLUSTERING = 80_000_000  # of hdbscan and what it stands on
TOUCHING_BYTES = 1_000  # of a splat, where those that touch are told
MEMBER_BYTES = 5  # of an entry: whether its splat belongs to its region, and to which
SMOOTHING_BYTES = 1_300  # of a splat: the graph as it is made, or with a block of channels
SPARE = 0.9  # of the free memory: 10 % are left to other processes
CARD_SPARE = 0.8  # of a card's free memory: what is freed does not lie in one piece
CARD_SPLAT_BYTES = 400  # of a splat on a card, walked in the smallest pieces


@dataclass(frozen=True)
class PlannedScene:
    """How many splats there are, and how rays meet them."""

    kernel: str
    antialiased: bool  # opacities are compensated for the low-pass
    rendering: str  # why: what says so, or who
    splats: int  # P

    @property
    def rendered(self) -> str:
        """The kernel and the rendering, for people."""
        return f"{self.kernel}, antialiased: {self.rendering}" if self.antialiased else self.kernel


def first_names(names: Sequence[str], most: int | None) -> str:
    """So many of the names, for people; None for all."""
    return ", ".join(names[:most]) + (", ..." if most is not None and len(names) > most else "")


def planned_scene(splats: Splats, settings: LiftSettings) -> PlannedScene:
    """Of these splats, as a lift with the settings has them."""
    antialiased = settings.lift_params.antialiased
    return PlannedScene(
        str(splats.kernel), antialiased, rendering_reason(splats.render_mode, antialiased), splats.count
    )


def scene_warnings(
    splats: Splats, cameras: Cameras, views: Sequence[Camera], settings: LiftSettings
) -> tuple[str, ...]:
    """Warnings of splats and cameras, and of lenses of the views among these."""
    rendering = rendering_warnings(splats.render_mode, settings.lift_params.antialiased, splats.kernel)
    return *splats.warnings, *rendering, *cameras.warnings, *distortion_warning(views)


@dataclass(frozen=True)
class Plan(PlannedScene):
    """What a lift is about to do. Plain values: the same inputs and settings give the same plan."""

    views: tuple[str, ...]  # that will be lifted, in the order of the sums
    left_out: tuple[str, ...]  # that the settings' coverage or view_cosine leaves out
    there: int  # views with features and a camera, whatever the settings take of them
    view_cosine: float | None  # expected of the views' features against those of all, where a pilot chose them
    spare: tuple[str, ...]  # of those lifted: what they show, WELL_COVERED of the others show too
    seen_share: float  # of the splats, that some view can see, before occlusion
    splats_a_view: float  # that a view can see, before occlusion
    levels: tuple[int, int] | None  # the one that the setting levels takes alone, and how many maps have; None: all
    channels: int  # F
    dtype: str  # that X is stored as, when it can hold the codebooks
    memory: Mapping[str, int]  # bytes a part at the peak, about
    weight_bytes: int  # of W of all views, about
    device: Device  # that will walk and solve
    kept_on_card: int  # bytes of W that may stay on a card between the phases
    features_room: int | None  # bytes of this machine's memory that X may take today; None for no limit
    seconds: float | None  # that looking through the views takes on this machine today, about; None for few views
    warnings: tuple[str, ...]  # of this machine, today
    told: tuple[str, ...]  # warnings of what is lifted, which the certificate of the lift has too

    def __repr__(self) -> str:
        views = f"{len(self.views)} of {self.there} views"
        memory = f"{self.memory_bytes / 2**30:.1f} GiB"
        warnings = f"{len(self.warnings) + len(self.told)} warnings"
        return one_line(self, f"{self.splats} of {self.kernel}", views, f"{self.channels} channels", memory, warnings)

    @property
    def memory_bytes(self) -> int:
        """The estimated peak."""
        return sum(self.memory.values())

    @property
    def in_files(self) -> int:
        """Bytes of W beyond those that stay in memory, about."""
        return max(0, self.weight_bytes - MEMORY_LIMIT - self.kept_on_card)

    def facts(self) -> dict[str, Any]:
        """Plain numbers for the certificate, without what only this machine has to do with."""
        return {
            "kernel": self.kernel,
            "antialiased": self.antialiased,
            "rendering": self.rendering,
            "splats": self.splats,
            "seen_share": self.seen_share,
            "splats_a_view": self.splats_a_view,
            "views": len(self.views),
            "views_left_out": len(self.left_out),
            "view_cosine": self.view_cosine,
            "spare_views": list(self.spare),
            "levels": None if self.levels is None else {"alone": self.levels[0], "of": self.levels[1]},
            "channels": self.channels,
            "dtype": self.dtype,
            "memory_bytes": self.memory_bytes,
            "memory": dict(self.memory),
            "weights_in_files_bytes": max(0, self.weight_bytes - MEMORY_LIMIT),
            "device": self.device.kind,
        }

    def summary(self) -> Iterator[str]:
        """The plan in short, for people: what is lifted, what it is made of, and what that takes."""
        seen = f"{self.seen_share:.1%} in some view's field"
        spare = f", {len(self.spare)} of them see nothing that {WELL_COVERED} others do not" if self.spare else ""
        yield f"{self.splats} splats ({self.rendered}), {seen}; {len(self.views)} of {self.there} views{spare}"
        level = f", level {self.levels[0]} alone of {self.levels[1]}, as the settings choose" if self.levels else ""
        yield f"{self.channels} channels, stored as {self.dtype}{level}"
        files = f", {self.in_files / MIB:.0f} MiB of region weights in files" if self.in_files else ""
        yield f"about {self.memory_bytes / MIB:.0f} MiB at the peak{files}, on {self.device.name}"

    def lines(self) -> Iterator[str]:
        """The whole plan for people."""
        head, channels, memory = self.summary()
        yield f"plan: {head}"
        yield f"  a view shows {self.splats_a_view:.0f} of them, before occlusion"
        left = f"{len(self.left_out)} views left out" if self.left_out else "no view left out"
        if self.view_cosine is not None:
            left += f" (a pilot expects features with a cosine of {self.view_cosine:.3f} to those of all)"
        yield f"  {left}{self._spare_line()}"
        yield f"  {channels}"
        parts = ", ".join(f"{name} {size / MIB:.0f}" for name, size in self.memory.items())
        yield f"  {memory} ({parts})"
        yield from (f"warning: {warning}" for warning in (*self.warnings, *self.told))

    def _spare_line(self) -> str:
        if not self.spare:
            return ""
        some = first_names(self.spare, SHOWN_VIEWS)
        return f"; {len(self.spare)} add nothing that {WELL_COVERED} others do not show: {some}"


@one_thread()
def plan_lift(
    splats: Splats,
    views: LiftViews,
    settings: LiftSettings,
    device: Device,
    threads: int | None = None,
    *,
    apart: bool = False,
    look: bool = False,
) -> Plan:
    """Plan the lift of the views; the settings' coverage and view_cosine may choose among them.

    Args:
        device: where it should run. A card with too little room leaves an ``auto`` lift to the processor.
        threads: that walk on the processor; None takes the cores that this process may use.
        apart: whether others hold W and X, so that this machine needs no room for them.
        look: whether a few views are weighed, to tell inputs that contradict each other and how long the views take.
            A lift in one place tells both by the views that it begins with.

    Raises:
        Unavailable: this machine has no room for the codebooks, or for the features in no place; or the card that
            the lift was sent to has none.
    """
    features = views.features
    names = views.names
    cameras = [views.cameras[name] for name in names]
    seen = visibility(splats, cameras, settings.lift_params, device, threads)
    short = [] if apart else check_card(device, splats.count, settings.device)
    device = CPU if short else device
    raster, seconds, wrong = None, None, list[str]()
    if look or _has_pilot(settings, len(names)):
        raster = open_raster(splats, device, threads)
    chosen, expected = _choose_views(raster, views, settings, seen)
    names, seen, cameras = [names[k] for k in chosen], seen.of(chosen), [cameras[k] for k in chosen]
    if look and raster is not None:  # of the views that a lift takes: as it does
        wrong = contradictions(raster, views.only(names), settings, seen.seen_share)
    if look and raster is not None and device.kind == "cpu":
        seconds = _seconds(raster, views, names, settings)
    dense = [name for name in names if _is_dense(features, name)]
    if dense and raster is None:
        raster = open_raster(splats, device, threads)
    met = _met_share(raster, views.only(dense), settings, seen) if dense and raster is not None else 1.0
    entries = _entries(seen, cameras, features, names, settings, met)
    weights = weight_bytes(seen, entries, settings)
    parts = memory_parts(splats, seen, cameras, features, names, settings, entries)
    free, on_card = (None, None) if apart else (free_memory(), None if short else device.free_bytes())
    kept = 0 if on_card is None else min(weights, int(CARD_SPARE * on_card) // 4)
    in_files = 0 if apart else max(0, weights - MEMORY_LIMIT - kept)
    lifted = set(names)
    return Plan(
        **vars(planned_scene(splats, settings)),
        views=tuple(names),
        left_out=tuple(name for name in views.names if name not in lifted),
        there=len(features),
        view_cosine=expected,
        spare=tuple(names[k] for k in spare_views(seen)),
        seen_share=seen.seen_share,
        splats_a_view=seen.splats_a_view,
        levels=_level_alone(features, names, settings),
        channels=features.channels,
        dtype=settings.dtype,
        memory=parts,
        weight_bytes=weights,
        device=device,
        kept_on_card=kept,
        features_room=features_room(parts, free),
        seconds=seconds,
        warnings=(*short, *check_memory(parts, free), *check_weights(in_files)),
        told=(
            *scene_warnings(splats, views.cameras, cameras, settings),
            *shape_warnings(features, cameras),
            *wrong,
        ),
    )


def _has_pilot(settings: LiftSettings, views: int) -> bool:
    """Whether the settings choose among so many views by what a pilot tells of them."""
    return bool(settings.view_cosine) and views > FEW_VIEWS


def _choose_views(
    raster: Raster | None, views: LiftViews, settings: LiftSettings, seen: Visibility
) -> tuple[list[int], float | None]:
    """The views to lift, ascending, and the cosine that a pilot expects of them, where one was flown.

    They show each splat ``coverage`` times and come to ``view_cosine``, whatever takes more of the same order. Where
    a pilot could spare no more views than it looks at, none is flown and all are taken.
    """
    every = list(range(seen.areas.shape[0]))
    if not settings.coverage and not _has_pilot(settings, len(every)):
        return every, None
    order = list(view_order(seen))
    least = views_to_show(seen, order, settings.coverage)
    if not settings.view_cosine:
        return sorted(order[:least]), None
    if raster is None or len(every) <= max(FEW_VIEWS, least + PILOT_VIEWS):
        return every, None
    pilot = estimate_view_noise(raster, views, settings, seen)
    count, expected = pilot.views_for(settings.view_cosine, order, least)
    return sorted(order[:count]), expected


def _seconds(raster: Raster, views: LiftViews, names: Sequence[str], settings: LiftSettings) -> float | None:
    """About how long the views take, by the one in the middle."""
    if len(names) < TIMED_VIEWS:
        return None
    begin = time.perf_counter()
    one = views.only([names[len(names) // 2]])
    own = settings.model_copy(update={"certificate_rays": 0})
    weigh_views(raster, raster.splats.count, one, own, silent, by_rows=False)
    return len(names) * (time.perf_counter() - begin)


def weight_bytes(seen: Visibility, entries: np.ndarray, settings: LiftSettings) -> int:
    """Bytes of W of all views with so many entries each [V], about."""
    judged = 4 if settings.robust_steps or settings.loss == "huber" else 0
    return int(ROW_BYTES * _shown(seen).sum() + (ENTRY_BYTES + judged) * entries.sum())


def _shown(seen: Visibility) -> np.ndarray:
    """[V] f64, the splats that each view shows, about."""
    return seen.in_view.sum(axis=1) / seen.areas.shape[1] * seen.splats


def _entries(
    seen: Visibility,
    cameras: Sequence[Camera],
    features: Views,
    names: Sequence[str],
    settings: LiftSettings,
    met: float,
) -> np.ndarray:
    """[V] f64, of W of each view, about: a splat meets a region or four cells in each tile and level that it touches.

    Of a dense map it meets the cells under its outline, as far as rays get to it.

    Args:
        met: of `_met_share`.
    """
    parts = max(_parts_a_tile(features, name, settings) for name in names)
    found = _shown(seen) * parts * _tiles(seen)
    for number, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        if _is_dense(features, name):
            sides = np.sqrt(seen.areas[number][seen.in_view[number]], dtype=np.float64)
            across, down = (
                sides * min(cells, reads * -(-pixels // settings.stride)) / pixels + reads
                for cells, pixels in zip(_cells(features, name, camera), (camera.width, camera.height), strict=True)
                for reads in (1 if cells == pixels or features.is_regions(name) else 2,)  # of a pixel, in a line
            )
            levels = 1 if isinstance(settings.levels, int) else _levels(features, name)
            found[number] = met * levels * float(across @ down) / seen.areas.shape[1] * seen.splats
    return found


def _is_dense(features: Views, view: str) -> bool:
    return math.prod(_codebook(features, view)[:-1]) > DENSE_ROWS


def _cells(features: Views, view: str, camera: Camera) -> tuple[float, float]:
    """Columns and rows of a grid; of regions those that as many squares on each level would have."""
    if not features.is_regions(view):
        rows, columns, _ = _codebook(features, view)
        return columns, rows
    side = math.sqrt(_codebook(features, view)[0] / _levels(features, view))
    return side * math.sqrt(camera.width / camera.height), side * math.sqrt(camera.height / camera.width)


def _met_share(raster: Raster, views: LiftViews, settings: LiftSettings, seen: Visibility) -> float:
    """The share of the outlines' area that rays get to, by some rays of a few views: what is opaque hides the rest.

    Args:
        views: of dense maps. seen: of all views that are lifted, whose mean area stands for that of each.
    """
    counts = list[float]()
    for number in sorted({0, len(views) // 2, len(views) - 1}):
        camera = views.cameras[views.names[number]]
        places = sample_pixels(camera, TRACED_RAYS, (settings.seed, number), settings.lift_params)
        lengths = raster.ray_rows(camera, places, settings.lift_params).indptr.diff().numpy()
        most = settings.k if settings.selection == "top-k" else lengths.max(initial=0)
        counts.append(float(lengths.clip(max=most).mean()) * camera.width * camera.height)
    area = float(seen.areas.sum(dtype=np.float64)) / len(seen.areas) / seen.areas.shape[1] * seen.splats
    return min(1.0, float(np.mean(counts)) / max(area, 1.0))


def memory_parts(
    splats: Splats,
    seen: Visibility,
    cameras: Sequence[Camera],
    features: Views,
    names: Sequence[str],
    settings: LiftSettings,
    entries: np.ndarray,
) -> dict[str, int]:
    """Bytes of each part of a lift at its peak, about.

    Args:
        entries: [V], of W of each view.
    """
    inputs = sum(t.nbytes for t in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits))
    largest, channels = max(camera.width * camera.height for camera in cameras), features.channels
    weights, of_all = weight_bytes(seen, entries, settings), float(entries.sum())
    view = int(_shown(seen).max(initial=0) * (RECORD_BYTES + TILE_BYTES * _tiles(seen))) + 16 * largest
    dense = max((int(own) for own, name in zip(entries, names, strict=True) if _is_dense(features, name)), default=0)
    books = [math.prod(_codebook(features, name)) for name in names]
    regions = sum(books) // max(channels, 1)
    size = 2 if settings.dtype == "float16" else 4
    parts = {
        "libraries": LIBRARIES,
        "splats": inputs,
        "scene": splats.count * SCENE_BYTES,
        "view": 2 * view + DENSE_BYTES * dense,  # two are in work, or one and what is made of it; of dense ones one
        "weights": min(weights, MEMORY_LIMIT),  # a view at a time
        "gathered": min(weights, MEMORY_LIMIT),  # of all views, a row a splat
        "codebooks": size * sum(books) + min(8 * sum(books), 2 * max(TABLE_BYTES, 4 * LEAST_CHANNELS * regions)),
        "features": splats.count * channels * size,
    }
    if settings.robust_steps or settings.loss == "huber":
        parts["reweighting"] = int(JUDGED_BYTES * min(of_all, MEMORY_LIMIT / ENTRY_BYTES))  # more lies in files
        if settings.consensus and any(features.is_regions(name) for name in names):
            parts["reweighting"] += int(CONSENSUS_BYTES * of_all + BLOCK_BYTES * min(of_all, BLOCK_ENTRIES))
    if settings.cg_steps or settings.reference_channels:
        parts["refinement"] = 4 * (splats.count * (CG_VECTORS * CG_CHANNELS) + 3 * largest * CG_CHANNELS)
    if settings.smoothness:
        parts["smoothing"] = SMOOTHING_BYTES * splats.count + int(MEMBER_BYTES * of_all)
    if settings.aggregation:
        parts["aggregation"] = CLUSTERING + 24 * channels * min(splats.count, settings.aggregation_sample)
        if settings.aggregation_clusters in ("auto", "touching"):  # afterwards, and of one cluster at a time
            parts["aggregation"] = max(parts["aggregation"], TOUCHING_BYTES * splats.count)
    return parts


def _tiles(seen: Visibility) -> float:
    """Tiles that a shown splat touches, in the mean."""
    sides = np.sqrt(seen.areas[seen.in_view], dtype=np.float64)
    return float(np.mean((sides / TILE + 1.0) ** 2)) if sides.size else 1.0


def _parts_a_tile(features: Views, view: str, settings: LiftSettings) -> int:
    if not features.is_regions(view):
        return 4  # nearest reads fewer, but fine cells are smaller than a tile
    return 1 if isinstance(settings.levels, int) else _levels(features, view)


def _levels(features: Views, view: str) -> int:
    """The levels of a view's region map; one of a grid."""
    shape = features.specs(view)["labels"].shape if features.is_regions(view) else ()
    return shape[0] if len(shape) == 3 else 1


def _level_alone(features: Views, names: Sequence[str], settings: LiftSettings) -> tuple[int, int] | None:
    """The level that the settings take alone, and how many the maps have; None where nothing is left out."""
    there = max(_levels(features, name) for name in names) if isinstance(settings.levels, int) else 1
    return (settings.levels, there) if isinstance(settings.levels, int) and there > 1 else None


def _codebook(features: Views, view: str) -> tuple[int, ...]:
    """The shape of the view's codebook, or of its grid."""
    return next(spec.shape for part, spec in features.specs(view).items() if part != "labels")


def check_card(device: Device, splats: int, asked: str) -> list[str]:
    """What to say when the card has no room for the scene and ``auto`` may take the processor.

    Raises:
        Unavailable: the same, and ``cuda`` was asked for.
    """
    free = device.free_bytes()
    least = splats * CARD_SPLAT_BYTES
    if free is None or least <= free:
        return []
    need, there = f"{least / GIB:.1f} GiB", f"{free / GIB:.1f} GiB"
    if asked == "cuda":
        raise Unavailable(
            "device", expected=f"{need} of free memory on {device.name}", got=there,
            hint="end what else runs there, take fewer splats, smaller images or fewer channels, or take device=cpu",
        )  # fmt: skip
    return [f"{device.name} has {there} free and the lift needs {need}: the processor lifts"]


def features_room(parts: Mapping[str, int], free: int | None) -> int | None:
    """Bytes that X may take beside the rest; None for no limit. Beyond them it is kept in a mapped file."""
    if free is None:
        return None
    return max(0, int(SPARE * free) - sum(parts.values()) + parts["features"])


def check_memory(parts: Mapping[str, int], free: int | None) -> list[str]:
    """What to say about the room that there is: nothing, or warnings.

    Raises:
        Unavailable: not even the codebooks fit, or there is no disk for features that do not.
    """
    if free is None:
        return []
    room = features_room(parts, free)
    there, rest = f"{free / GIB:.1f} GiB", sum(parts.values()) - parts["features"]
    hint = "try fewer views (coverage) or fewer channels"
    if parts["codebooks"] > free:
        got = f"{parts['codebooks'] / GIB:.1f} GiB for codebooks"
        raise Unavailable("memory", expected=f"at most the {there} that are free", got=got, hint=hint)
    told = []
    if room is not None and parts["features"] > room:
        check_disk(parts["features"], "features")
        size = f"{parts['features'] / GIB:.1f} GiB"
        told.append(f"the features, {size}, do not fit into the {there} that are free: they go through a mapped file")
    if rest > SPARE * free:
        told.append(f"the rest of the lift may take {rest / GIB:.1f} GiB and {there} are free: {hint}")
    return told


def check_weights(size: int) -> list[str]:
    """What to say of so many bytes of region weights in the temporary folder: nothing, or a warning."""
    got = lack_of_disk(size) if size else ""
    if not got:
        return []
    told = f"region weights of about {size / GIB:.1f} GiB go to files in {tempfile.gettempdir()}, and there is {got}"
    return [f"{told}: set TMPDIR to a folder with more room on a disk, or try fewer views (coverage)"]
