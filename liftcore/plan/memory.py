"""What a lift will hold in memory at its peak, part by part, and how much the machine has left."""

from __future__ import annotations

import math
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import Unavailable
from liftcore.features.lens import kept_bytes
from liftcore.raster.base import TILE
from liftcore.raster.cpu.project import COLUMNS
from liftcore.solve.channels import BLOCK
from liftcore.solve.clustering import BLOCK as CLUSTERED_ROWS
from liftcore.solve.columns import by_rows
from liftcore.solve.feature_room import check_disk, lack_of_disk
from liftcore.solve.gathering import CHUNK_ENTRIES
from liftcore.solve.view_weights import MEMORY_LIMIT
from liftcore.solve.weighted_sums import strip_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from liftcore.features.pack import FeaturePacks, TensorSpec
    from liftcore.plan.entries import PlannedEntries
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.settings import LiftSettings

LIBRARIES = 450_000_000  # of torch, numba, numpy and the compiled kernels, before anything is read
ENTRY_BYTES, ROW_BYTES = 8, 20  # column and weight; a splat's ids, row start and evidence
JUDGED_BYTES = 8  # what the robust step finds of a gathered entry
LISTED_BYTES = 4 + 4  # of a splat in the list of a tile: as it is found, and in its place
WALKED_BYTES = 60  # of an entry of the walk: 16 before it is gathered, 8 after, 8 of its column, and growing arrays
SCENE_BYTES = 9 * 8 + 3 * 8 + 8 * 8  # axes, opacities, reach; evidence, denominators, scale, order of the solution
VECTORS = 10  # [P, C] f32 of a block of conjugate gradients, with those that its sums pass through
IMAGES = 3  # [H, W, C] f32: rendered, what is left of B, and the way back
TAP_BYTES, RAY_BYTES = 16, 8  # column and share; a ray's number
UNIT_ROWS = 6  # [n, F] f32 on the way from features to directions
CLUSTERING = 80_000_000  # of hdbscan and what it stands on
WALK_BYTES = 68  # of a splat of the scene in the walk of a view, seen or not: depth, id, counts and sums of the merge
CONTROL_GROUPS = (  # folder, and the files of limit, use and statistics: versions 2 and 1
    ("/sys/fs/cgroup", ("memory.max", "memory.current", "memory.stat")),
    ("/sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat")),
)
FILE_PAGES = ("inactive_file", "active_file")
DENSE_ENTRIES = 12.0  # of a splat in a view: twice those of an encoder's grid of some thirty cells a side
SPARE = 0.9  # of the memory that is free: others grow too


def memory_parts(
    splats: Splats,
    packs: FeaturePacks,
    cameras: Mapping[str, Camera],
    planned: PlannedEntries,
    settings: LiftSettings,
) -> dict[str, int]:
    """Bytes of each part of a lift at its peak, with one view in work.

    What comes after the walks has the room that the view had: ``refinement`` and ``aggregation`` are what they take
    beyond it.

    Args:
        cameras: the views that are lifted, by name.
        planned: what the walks will make.
    """
    inputs = sum(t.nbytes for t in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits))
    largest = max(camera.width * camera.height for camera in cameras.values())
    gathered = min(int(len(cameras) * planned.splats * planned.entries), CHUNK_ENTRIES)
    weights = weight_bytes(planned.splats, planned.entries)
    seen = 8 * COLUMNS[splats.kernel] + LISTED_BYTES * planned.listed + WALKED_BYTES * planned.walked  # of a splat
    labels = max(_label_bytes(packs, view) for view in cameras)
    walk = int(planned.splats * seen) + splats.count * WALK_BYTES + 8 * largest // TILE**2
    # Labels of the next one, too, and weights that wait for their turn.
    view = walk + 2 * labels + kept_bytes(cameras.values()) + weights
    parts = {
        "libraries": LIBRARIES,
        "splats": inputs,
        "scene": splats.count * SCENE_BYTES,
        "view": view,
        "weights": min(len(cameras) * weights, MEMORY_LIMIT),
        "gathered": gathered * (ENTRY_BYTES + (JUDGED_BYTES if settings.robust_steps else 0)),
        "codebooks": _all_codebook_bytes(packs, cameras, settings),
        "features": splats.count * packs.channels * (2 if settings.dtype == "float16" else 4),
    }
    if settings.cg_steps or settings.reference_channels:
        parts["refinement"] = max(0, _refinement_bytes(splats.count, packs, cameras, settings) - view)
    if settings.aggregation:
        rows = UNIT_ROWS * 4 * packs.channels
        parts["view"] = max(view, rows * CLUSTERED_ROWS)  # each thread has a block of splats in work
        parts["aggregation"] = CLUSTERING + rows * min(splats.count, settings.aggregation_sample)
    return parts


def all_weight_bytes(planned: PlannedEntries, views: int, settings: LiftSettings) -> int:
    """Bytes of W of so many views."""
    judged = planned.splats * planned.entries * 4 if settings.robust_steps else 0.0  # weights as they were judged
    return int(views * (weight_bytes(planned.splats, planned.entries) + judged))


def weights_in_files(size: int) -> int:
    """Of so many bytes of W those that go to files of the temporary folder, as memory keeps no more of it."""
    return max(0, size - MEMORY_LIMIT)


def dense_warning(planned: PlannedEntries, size: int) -> list[str]:
    """A warning where maps so fine make so many bytes of W that coarser ones would be worth the user's while."""
    if planned.entries < DENSE_ENTRIES or not weights_in_files(size):
        return []
    told = f"a splat has weights in about {planned.entries:.0f} regions or cells of each view's map"
    advice = "regions, or coarser grids, of the same features lift faster"
    return [f"the maps are dense: {told}, about {size / 2**30:.1f} GiB in all; {advice}"]


def check_weights(size: int) -> list[str]:
    """What to say of so many bytes of region weights in the temporary folder: nothing, or a warning."""
    got = lack_of_disk(size) if size else ""
    if not got:
        return []
    told = (
        f"region weights of about {size / 2**30:.1f} GiB go to files in {tempfile.gettempdir()}, and there is {got}"
    )
    return [f"{told}: set TMPDIR to a folder with more room on a disk, or try fewer views (coverage)"]


def free_memory() -> int | None:
    """Bytes that this process may still take: of the machine, or of its control group; None where neither says."""
    found = []
    with suppress(OSError, ValueError):  # not Linux
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    for folder, names in CONTROL_GROUPS:
        with suppress(OSError, ValueError):  # a machine has one of the two, or none
            limit, used, stat = (Path(folder, name).read_text(encoding="ascii") for name in names)
            found += [group_memory(limit, used, stat)]
    return min((room for room in found if room is not None), default=None)


def group_memory(limit: str, used: str, stat: str) -> int | None:
    """Bytes that a control group has left, from the texts of its files; None where it has no limit.

    What is used counts the files that were read, which make room when memory is asked for: they are free.

    Raises:
        ValueError: the texts are not those of a control group.
    """
    if limit.strip() == "max":
        return None
    counts = dict(line.split() for line in stat.splitlines())
    names = [f"total_{name}" if f"total_{name}" in counts else name for name in FILE_PAGES]  # version 1: all below it
    cached = sum(int(counts.get(name, 0)) for name in names)
    return max(0, int(limit) - max(0, int(used) - cached))


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
    there, rest = f"{free / 2**30:.1f} GiB", sum(parts.values()) - parts["features"]
    hint = "try fewer views (coverage) or fewer channels"
    if parts["codebooks"] > free:
        got = f"{parts['codebooks'] / 2**30:.1f} GiB for codebooks"
        raise Unavailable("memory", expected=f"at most the {there} that are free", got=got, hint=hint)
    told = []
    if room is not None and parts["features"] > room:
        check_disk(parts["features"])
        size = f"{parts['features'] / 2**30:.1f} GiB"
        told.append(f"the features, {size}, do not fit into the {there} that are free: they go through a mapped file")
    if rest > SPARE * free:
        told.append(f"the rest of the lift may take {rest / 2**30:.1f} GiB and {there} are free: {hint}")
    return told


def weight_bytes(rows: float, entries: float) -> int:
    """Of W with so many rows of so many entries."""
    return int(rows * (ROW_BYTES + ENTRY_BYTES * entries))


def all_columns(packs: FeaturePacks, views: Iterable[str], settings: LiftSettings) -> int:
    """Columns of W of all views, at most."""
    names = list(views)
    most = 1 if by_rows(settings) else most_levels(packs, names)  # tuples of a view for each row of its codebook
    return most * sum(codebook_rows(packs, view) for view in names)


def most_levels(packs: FeaturePacks, views: Iterable[str]) -> int:
    """The levels of the view that has most of them."""
    labels = [packs.specs(view).get("labels") for view in views]
    return max(spec.shape[0] if spec is not None and len(spec.shape) == 3 else 1 for spec in labels)


def codebook_rows(packs: FeaturePacks, view: str) -> int:
    """Rows of the view's codebook; of a grid, its cells."""
    return math.prod(_codebook_spec(packs, view).shape[:-1])


def _label_bytes(packs: FeaturePacks, view: str) -> int:
    """Of the view's labels as they are walked; a grid's cells are labels where the nearest one is read."""
    spec = packs.specs(view).get("labels")
    return 4 * (codebook_rows(packs, view) if spec is None else math.prod(spec.shape))


def _refinement_bytes(count: int, packs: FeaturePacks, cameras: Mapping[str, Camera], settings: LiftSettings) -> int:
    """Of a block of conjugate gradients for so many splats, and of the optimum that the reference keeps."""
    refined = min(BLOCK, settings.cg_basis or packs.channels) if settings.cg_steps else 0
    channels = max(refined, min(BLOCK, settings.reference_channels))
    pixels = [camera.width * camera.height for camera in cameras.values()]
    rays = max(pixels[k] * _row_bytes(packs, view, settings) for k, view in enumerate(cameras))
    images = max(pixels) * IMAGES * channels * 4
    return count * 4 * (VECTORS * channels + settings.reference_channels) + images + rays + sum(pixels)


def _row_bytes(packs: FeaturePacks, view: str, settings: LiftSettings) -> int:
    """Of what a pixel's rows of B are read from: four cells of a grid, or a region a level."""
    if packs.is_regions(view):
        levels = most_levels(packs, [view]) if settings.levels == "rows" else 1
        return levels * (RAY_BYTES + TAP_BYTES)
    return RAY_BYTES + TAP_BYTES * (4 if settings.grid_reading == "bilinear" else 1)


def _all_codebook_bytes(packs: FeaturePacks, views: Iterable[str], settings: LiftSettings) -> int:
    """Of the codebooks, and of the strips of what W's columns stand for that the solution has beside.

    Means over tuples of what is no unit vector have strips of those vectors' means, too. Which are, nobody knows
    before they are read.
    """
    names = list(views)
    halves = all(_codebook_spec(packs, view).dtype == "F16" for view in names)
    size = 2 if halves and (by_rows(settings) or settings.dtype == "float16") else 4
    means = not by_rows(settings) and most_levels(packs, names) > 1
    strips = strip_bytes(all_columns(packs, names, settings), packs.channels, size + (4 if means else 0))
    return sum(_codebook_bytes(packs, view) for view in names) + strips


def _codebook_bytes(packs: FeaturePacks, view: str) -> int:
    """Of the view's codebook as it is kept: float16 stays, all else is float32."""
    spec = _codebook_spec(packs, view)
    return math.prod(spec.shape) * (2 if spec.dtype == "F16" else 4)


def _codebook_spec(packs: FeaturePacks, view: str) -> TensorSpec:
    return next(spec for part, spec in packs.specs(view).items() if part != "labels")
