"""`splatlift bench`: how long a view takes, stage by stage, and how much memory the whole lift needs."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from liftcore.device import Device, choose_device
from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware, peak_memory
from liftcore.evaluate.region_walk import walk_regions
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.features.views import Regions, ViewFeatures
from liftcore.progress import silent
from liftcore.raster.open_raster import open_raster
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.host import Host
from liftcore.solve.solver import closed_form
from liftcore.solve.view_weights import WeightStore
from liftcore.warm_up import warm_up_lift

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats


PASSES = 3  # over all views, of which the median counts


@dataclass(frozen=True)
class Workload:
    """What is lifted: a scene, and views with label maps over random unit codebooks."""

    name: str
    splats: Splats
    views: Sequence[tuple[Camera, ViewFeatures]]


def run_bench(options: dict[str, Any]) -> dict[str, Any]:
    """Time the lift of a real scene (``scene``: a folder) or of a synthetic room.

    Args:
        options: scene (folder or None), splats, size ("WxH"), channels, levels, views, threads, device ("auto", "cpu"
            or "cuda"); preset (one alone, else all); stages (bool): every step apart, on one thread, as
            ``liftcore.evaluate.stages`` has it; aims (bool), as ``liftcore.evaluate.aims`` has them.

    Returns:
        Plain numbers, ready for JSON: hardware, versions, seconds a view by stage (medians), peak memory.
    """
    asked = LiftSettings.of(device=options.get("device") or "auto").device
    if options.get("stages") and asked == "cuda":
        raise InvalidInput("device", expected="cpu beside stages, which are the processor's", got=asked)
    if options.get("aims") and options.get("channels"):
        raise InvalidInput(
            "channels", expected="none beside aims, which have their own", got=str(options["channels"])
        )
    device = choose_device("cpu" if options.get("stages") else asked)
    work = _workload(options | ({"channels": 1} if options.get("aims") else {}))
    start = time.perf_counter()
    warm_up_lift(work.splats.kernel, device, LiftSettings.of(preset=Preset.ROW_SUM))
    compile_seconds = time.perf_counter() - start
    channels: int | list[int] = work.views[0][1].codebook.shape[1]
    if options.get("stages"):
        from liftcore.evaluate.stages import time_stages

        chosen = _presets(options, (Preset.ROW_SUM, Preset.TIKHONOV))
        presets = {str(preset): time_stages(work, preset) for preset in chosen}
    elif options.get("aims"):
        from liftcore.evaluate.aims import CHANNELS, measure_aims

        chosen = _presets(options, (Preset.ROW_SUM,))
        presets = {str(preset): measure_aims(work, preset, device, options.get("threads")) for preset in chosen}
        channels = list(CHANNELS)
    else:
        chosen = _presets(options, tuple(Preset))
        presets = {str(preset): time_lift(work, preset, device, options.get("threads")) for preset in chosen}
    return {
        "workload": work.name,
        "splats": work.splats.count,
        "views": len(work.views),
        "width": work.views[0][0].width,
        "height": work.views[0][0].height,
        "channels": channels,
        "levels": options.get("levels") or 4,
        "compile_or_load_s": compile_seconds,
        "presets": presets,
        "peak_memory_bytes": peak_memory(),
        "hardware": hardware() | ({} if device.kind == "cpu" else {"device": device.facts()}),
    }


def time_lift(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """Seconds a view of geometry and solution: medians over PASSES of all views, each as a lift walks them.

    ``geometry_s_per_view_min`` is that of the shortest pass.
    """
    settings, count = LiftSettings.of(preset=preset), work.splats.count
    looking, raster = (settings.lift_params, settings.weighting), open_raster(work.splats, device, threads)
    with WeightStore() as store:  # for the caches alone
        walk_regions(raster, work.views[:1], looking, count, store)
    geometry, solution, entries = [], [], 0
    for _ in range(PASSES):
        with WeightStore() as store:
            start = time.perf_counter()
            denominators, columns = walk_regions(raster, work.views, looking, count, store)
            middle = time.perf_counter()
            host = Host(threads, means=work.splats.means)
            closed_form(store, columns, denominators, torch.float16, silent, device, host)
            geometry.append((middle - start) / len(work.views))
            solution.append((time.perf_counter() - middle) / len(work.views))
            entries = sum(len(part.columns) for part in store)
    return {
        "geometry_s_per_view": statistics.median(geometry),
        "geometry_s_per_view_min": min(geometry),
        "solve_s_per_view": statistics.median(solution),
        "total_s_per_view": statistics.median(map(sum, zip(geometry, solution, strict=True))),
        "weights_entries_per_view": entries / len(work.views),
    }


def _presets(options: dict[str, Any], every: Sequence[Preset]) -> Sequence[Preset]:
    return [LiftSettings.of(preset=options["preset"]).preset] if options.get("preset") else every


def _workload(options: dict[str, Any]) -> Workload:
    channels, levels = options.get("channels") or 512, options.get("levels") or 4
    count = options.get("views") or 8
    if options.get("scene"):
        return _real(Path(options["scene"]), channels, levels, count)
    width, height = _size(options.get("size") or "986x728")
    cameras = room_cameras(count, width, height)
    splats = room_splats(options.get("splats") or 1_000_000)
    views = [(camera, room_regions(camera, k, levels, channels)) for k, camera in enumerate(cameras)]
    return Workload("synthetic room", splats, views)


def _real(folder: Path, channels: int, levels: int, count: int) -> Workload:
    """A scene folder with point_cloud.ply, cameras and regions.safetensors or features.safetensors."""
    from liftcore.features.pack import pair, read_features
    from liftcore.io.cameras import read_cameras
    from liftcore.io.ply import read_splats

    packs = [folder / name for name in ("regions.safetensors", "features.safetensors") if (folder / name).is_file()]
    if not packs:
        raise InvalidInput("scene", expected="a folder with regions.safetensors", got=str(folder))
    inria = folder / "cameras.json"
    cameras = read_cameras(inria if inria.is_file() else folder)
    features = pair(read_features(*packs[:1]), cameras)[0]
    views = []
    for number, name in enumerate(features.views[:count]):
        observed = features[name]
        if not isinstance(observed, Regions):
            raise InvalidInput("scene", expected="a pack of region maps", got=f"grids in {packs[0].name}")
        repeats = -(-levels // observed.labels.shape[0])
        labels = observed.labels.repeat(repeats, 1, 1)[:levels]
        generator = torch.Generator().manual_seed(number)
        codebook = torch.randn(observed.codebook.shape[0], channels, generator=generator)
        codebook = torch.nn.functional.normalize(codebook, dim=1).half()
        views.append((cameras[name], Regions(labels, codebook)))
    return Workload(folder.name, read_splats(folder / "point_cloud.ply"), views)


def _size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise InvalidInput("size", expected="WIDTHxHEIGHT in pixels", got=repr(text))
    return int(parts[0]), int(parts[1])
