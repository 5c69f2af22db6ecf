"""`splatlift bench`: how long a view takes to lift, and how much memory that needs."""

import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware, peak_memory
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.raster import open_raster
from liftcore.raster.base import Raster, ViewRequest
from liftcore.runtime.device import Device, choose_device
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Splats
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook, ViewCodebook, as_regions
from liftcore.values.region_weights import RegionWeights, stacked
from liftcore.values.settings import LiftSettings, Preset
from liftcore.values.views import Regions, ViewFeatures

PASSES = 3  # over all views, of which the median counts
PACKS = ("regions.safetensors", "features.safetensors")  # of a scene folder, the first that is there


@dataclass(frozen=True)
class Workload:
    """What is lifted: a scene, and views with label maps over random unit codebooks."""

    name: str
    splats: Splats
    views: Sequence[tuple[Camera, ViewFeatures]]


def run_bench(options: Mapping[str, Any]) -> dict[str, Any]:
    """Time the lift of a real scene or of a synthetic room, by all presets or by one.

    Args:
        options: as `workload` takes them; ``threads``, ``preset``, and ``device`` ("auto", "cpu" or "cuda"). What is
            not named or None has its default.

    Returns:
        Plain numbers, ready for JSON: hardware, versions, seconds a view by stage (medians), peak memory.

    Raises:
        InvalidInput: a size or a folder that makes no workload. InvalidSettings: an unknown preset or device.
    """
    device = choose_device(LiftSettings.of(device=options.get("device") or "auto").device)
    presets = [LiftSettings.of(preset=options["preset"]).preset] if options.get("preset") else list(Preset)
    work = workload(options)
    start = time.perf_counter()
    warm_up_lift(work.splats.kernel, device, LiftSettings.of(preset=Preset.ROW_SUM))
    compile_seconds = time.perf_counter() - start
    camera, observed = work.views[0]
    return {
        "workload": work.name,
        "splats": work.splats.count,
        "views": len(work.views),
        "width": camera.width,
        "height": camera.height,
        "channels": observed.codebook.shape[1],
        "levels": options.get("levels") or 4,
        "compile_or_load_s": compile_seconds,
        "presets": {str(preset): time_lift(work, preset, device, options.get("threads")) for preset in presets},
        "peak_memory_bytes": peak_memory(),
        "hardware": hardware() | ({} if device.kind == "cpu" else {"device": device.facts()}),
    }


def time_lift(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """Seconds a view of geometry and solution: medians over PASSES of all views, each as a lift walks them.

    ``geometry_s_per_view_min`` is that of the shortest pass.
    """
    settings, count = LiftSettings.of(preset=preset).for_splats(work.splats), work.splats.count
    looking, raster = (settings.lift_params, settings.weighting), open_raster(work.splats, device, threads)
    weigh_regions(raster, work.views[:1], looking, count, threads)  # for the caches alone
    geometry, solution, entries = [], [], 0
    for _ in range(PASSES):
        start = time.perf_counter()
        W, codebook = weigh_regions(raster, work.views, looking, count, threads)
        middle = time.perf_counter()
        solve(W, codebook, torch.float16, means=work.splats.means, threads=threads, device=device)
        geometry.append((middle - start) / len(work.views))
        solution.append((time.perf_counter() - middle) / len(work.views))
        entries = W.region.shape[0]
    return {
        "geometry_s_per_view": statistics.median(geometry),
        "geometry_s_per_view_min": min(geometry),
        "solve_s_per_view": statistics.median(solution),
        "total_s_per_view": statistics.median(map(sum, zip(geometry, solution, strict=True))),
        "weights_entries_per_view": entries / len(work.views),
    }


@one_thread()
def weigh_regions(
    raster: Raster,
    views: Sequence[tuple[Camera, ViewFeatures]],
    looking: tuple[CompositingParams, Weighting],
    count: int,
    threads: int | None = None,
) -> tuple[RegionWeights, Codebook]:
    """W of all views and what its regions stand for, as a lift makes them for the closed form.

    Args:
        count: P.
    """
    codebooks: list[ViewCodebook] = []
    nowhere = torch.empty(0, 2, dtype=torch.int32)

    def requests() -> Iterator[ViewRequest]:
        for camera, observation in views:
            regions, own = as_regions(observation, by_rows=False)
            codebooks.append(own)
            yield ViewRequest(camera, regions, *looking, nowhere)

    found = enumerate(raster.iterate_views(requests()))
    parts = [codebooks[number].counted(view.weights) for number, view in found]
    return stacked(parts, count, threads), Codebook(tuple(codebooks))


def workload(options: Mapping[str, Any]) -> Workload:
    """What to lift.

    Args:
        options: ``scene``, a folder with point_cloud.ply, cameras and region maps; without it a synthetic room of
            ``splats`` and of images of ``size`` ("WxH"). ``channels``, ``levels`` of labels, and at most ``views``.

    Raises:
        InvalidInput: the size is none, or the folder lacks something.
    """
    channels, levels = options.get("channels") or 512, options.get("levels") or 4
    count, folder = options.get("views") or 8, options.get("scene")
    if folder:
        return _real(Path(folder), channels, levels, count)
    size = options.get("size") or "986x728"
    width, times, height = size.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit()):
        raise InvalidInput("size", expected="WIDTHxHEIGHT in pixels", got=repr(size))
    cameras = room_cameras(count, int(width), int(height))
    views = [(camera, room_regions(camera, k, levels, channels)) for k, camera in enumerate(cameras)]
    return Workload("synthetic room", room_splats(options.get("splats") or 1_000_000), views)


def _real(folder: Path, channels: int, levels: int, count: int) -> Workload:
    from liftcore.io.cameras import read_cameras
    from liftcore.io.splats import read_splats
    from liftcore.values.pack import pair, read_features

    pack = next((folder / name for name in PACKS if (folder / name).is_file()), None)
    if pack is None:
        raise InvalidInput("scene", expected="a folder with regions.safetensors", got=str(folder))
    inria = folder / "cameras.json"
    cameras = read_cameras(inria if inria.is_file() else folder)
    features, views = pair(read_features(pack), cameras)[0], []
    for number, name in enumerate(features.views[:count]):
        observed = features[name]
        if not isinstance(observed, Regions):
            raise InvalidInput("scene", expected="a pack of region maps", got=f"grids in {pack.name}")
        labels = observed.labels.repeat(-(-levels // observed.labels.shape[0]), 1, 1)[:levels]
        generator = torch.Generator().manual_seed(number)
        codebook = torch.randn(observed.codebook.shape[0], channels, generator=generator, dtype=torch.float32)
        views.append((cameras[name], Regions(labels, torch.nn.functional.normalize(codebook, dim=1).half())))
    return Workload(folder.name, read_splats(folder / "point_cloud.ply"), views)
