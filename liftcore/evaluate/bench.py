"""`splatlift bench`: the time of a lift per view, and its memory."""

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware, machine_speed, peak_memory
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.lifting.pipeline import lift
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.raster import open_raster
from liftcore.raster.base import Raster, ViewRequest
from liftcore.runtime.arguments import as_path, check_count
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
PACKS = ("regions.safetensors", "features.safetensors")  # of a scene folder, the first that exists


@dataclass(frozen=True)
class Workload:
    """The input of a benchmark: a scene, and views with label maps over random unit codebooks."""

    name: str
    splats: Splats
    views: Sequence[tuple[Camera, ViewFeatures]]


def run_bench(
    scene: Path | str | None = None,
    *,
    splats: int = 1_000_000,
    size: str = "986x728",
    channels: int = 512,
    levels: int = 4,
    views: int = 8,
    threads: int | None = None,
    preset: str | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """Time the lift of a real scene or of a synthetic room, by all presets or by one.

    Args:
        scene: a folder with point_cloud.ply, cameras and region maps; None: a synthetic room.
        splats: of the room. size: of its images, WIDTHxHEIGHT in pixels.
        channels: of features. levels: of labels. views: at most.
        threads: None uses the cores that this process may use. preset: None: all. device: auto, cpu or cuda.

    Returns:
        Plain numbers, ready for JSON: hardware, versions, seconds a view by stage (medians), the stages
        of a whole lift as shares of its geometry, the machine's memory bandwidth and flops, peak memory.

    Raises:
        InvalidInput: a size or a folder that makes no workload. InvalidSettings: a count that is none, or an unknown
            preset or device.
    """
    bench_device = choose_device(LiftSettings.of(device=device).device)
    presets = [LiftSettings.of(preset=preset).preset] if preset else list(Preset)
    for name, count in {"splats": splats, "channels": channels, "levels": levels, "views": views}.items():
        check_count(name, count)
    check_count("threads", threads, "all cores")
    if scene:
        work = _scene_workload(as_path(scene, "scene"), channels, levels, views)
    else:
        work = _room_workload(splats, size, channels, levels, views)
    start = time.perf_counter()
    warm_up_lift(work.splats.kernel, bench_device, LiftSettings.of(preset=Preset.ROW_SUM))
    compile_seconds = time.perf_counter() - start
    camera, observed = work.views[0]
    return {
        "workload": work.name,
        "splats": work.splats.count,
        "views": len(work.views),
        "width": camera.width,
        "height": camera.height,
        "channels": observed.codebook.shape[1],
        "levels": levels,
        "compile_or_load_s": compile_seconds,
        "presets": {str(preset_name): time_lift(work, preset_name, bench_device, threads) for preset_name in presets},
        "peak_memory_bytes": peak_memory(),
        "machine_speed": machine_speed(threads),
        "hardware": hardware() | ({} if bench_device.kind == "cpu" else {"device": bench_device.facts()}),
    }


def time_lift(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """Time geometry and solution in seconds per view: medians over PASSES of all views, in the order of a lift.

    ``geometry_s_per_view_min`` is that of the shortest pass.
    """
    settings, count = LiftSettings.of(preset=preset).for_splats(work.splats), work.splats.count
    parameters, raster = (settings.lift_params, settings.weighting), open_raster(work.splats, device, threads)
    weigh_regions(raster, work.views[:1], parameters, count, threads)  # fills the caches
    geometry, solution, entries = [], [], 0
    for _ in range(PASSES):
        start = time.perf_counter()
        W, codebook = weigh_regions(raster, work.views, parameters, count, threads)
        middle = time.perf_counter()
        solve(W, codebook, torch.float16, means=work.splats.means, threads=threads)
        geometry.append((middle - start) / len(work.views))
        solution.append((time.perf_counter() - middle) / len(work.views))
        entries = W.region.shape[0]
    return {
        "geometry_s_per_view": statistics.median(geometry),
        "geometry_s_per_view_min": min(geometry),
        "solve_s_per_view": statistics.median(solution),
        "total_s_per_view": statistics.median(map(sum, zip(geometry, solution, strict=True))),
        "weights_entries_per_view": entries / len(work.views),
        "stages_of_geometry": stage_shares(work, preset, device, threads),
    }


def stage_shares(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, float]:
    """Time a full lift: seconds of each stage, and of ``all``, over those of geometry; compilation is excluded."""
    cameras = {camera.name: camera for camera, _ in work.views}
    views = {camera.name: observed for camera, observed in work.views}
    result = lift(work.splats, cameras, views, preset, device=device.kind, threads=threads, progress=False)
    stages = {name: seconds for name, seconds in result.metadata.timings.items() if name != "compile"}
    return {name: seconds / stages["geometry"] for name, seconds in (stages | {"all": sum(stages.values())}).items()}


@one_thread()
def weigh_regions(
    raster: Raster,
    views: Sequence[tuple[Camera, ViewFeatures]],
    parameters: tuple[CompositingParams, Weighting],
    count: int,
    threads: int | None = None,
) -> tuple[RegionWeights, Codebook]:
    """Compute W of all views and the codebook of its regions, as a lift does for the closed form.

    Args:
        count: P.
    """
    codebooks: list[ViewCodebook] = []
    no_pixels = torch.empty(0, 2, dtype=torch.int32)

    def requests() -> Iterator[ViewRequest]:
        for camera, observation in views:
            regions, codebook = as_regions(observation, by_rows=False)
            codebooks.append(codebook)
            yield ViewRequest(camera, regions, *parameters, no_pixels)

    answers = enumerate(raster.iterate_views(requests()))
    parts = [codebooks[number].weights_by_row(view.weights) for number, view in answers]
    return stacked(parts, count, threads), Codebook(tuple(codebooks))


def _room_workload(splats: int, size: str, channels: int, levels: int, views: int) -> Workload:
    width, times, height = str(size).lower().partition("x")
    if not (times and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InvalidInput("size", expected="WIDTHxHEIGHT in pixels", got=repr(size)[:80])
    cameras = room_cameras(views, int(width), int(height))
    observed = [(camera, room_regions(camera, k, levels, channels)) for k, camera in enumerate(cameras)]
    return Workload("synthetic room", room_splats(splats), observed)


def _scene_workload(folder: Path, channels: int, levels: int, count: int) -> Workload:
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
