"""`splatlift bench`: how long a view takes, stage by stage, and how much memory the whole lift needs."""

import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from liftcore.device import Device, choose_device
from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware, peak_memory, watched
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.features.views import Regions, ViewFeatures
from liftcore.progress import silent
from liftcore.raster import open_raster
from liftcore.raster.base import CompositingParams, Raster, ViewRequest, Weighting
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.columns import Columns, by_tuples
from liftcore.solve.host import Host
from liftcore.solve.solver import closed_form
from liftcore.solve.totals import row_totals
from liftcore.solve.view_weights import WeightStore
from liftcore.warm_up import warm_up_lift

PASSES = 3  # over all views, of which the median counts
CHANNELS = FEW, USUAL, MANY = 64, 512, 1024
# Aims of seconds a view, USUAL channels on two cores, by workload, splats and image.
VIEW_SECONDS = {("plush", 179_788, 990, 742): 0.15, ("synthetic room", 1_000_000, 986, 728): 0.30}
CHANNELS_RATIO = 1.1  # a view with MANY channels over one with FEW
BEYOND_BYTES = 1 << 30  # the most memory beside inputs and X


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
            ``liftcore.evaluate.stages`` has it; aims (bool).

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


def walk_regions(
    raster: Raster,
    views: Sequence[tuple[Camera, ViewFeatures]],
    looking: tuple[CompositingParams, Weighting],
    count: int,
    store: WeightStore,
) -> tuple[np.ndarray, list[Columns]]:
    """W of every view into the store; the denominators [P] f64 and the columns of W, as the closed form takes them.

    Args:
        count: P.
    """
    denominators, columns = np.zeros(count), []
    nowhere = torch.empty(0, 2, dtype=torch.int32)

    def looks() -> Iterator[ViewRequest]:
        for camera, observation in views:
            walked, own = by_tuples(observation)
            columns.append(own)
            yield ViewRequest(camera, walked, *looking, nowhere)

    for number, walked in enumerate(raster.iterate_views(looks())):
        weights = columns[number].weighted(walked.weights)
        home = weights.on_host()
        denominators[home.splats.numpy()] += row_totals(home)
        store.append(weights)
    return denominators, columns


def measure_aims(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """The figures that the project set itself as aims, beside what this machine does.

    One walk of all views a pass, and of its W the solution with few, usual and many channels: what a channel costs is
    then no matter of how busy the machine was between two runs.

    Returns:
        ``aims``, and the figures behind them: seconds a view of geometry, and of the solution by channels; bytes, the
        peak without pages of files where the system tells it.
    """
    settings, count = LiftSettings.of(preset=preset), work.splats.count
    looking, raster = (settings.lift_params, settings.weighting), open_raster(work.splats, device, threads)
    geometry, solution = [], {channels: [] for channels in CHANNELS}
    peaks: dict[int, int] = {}
    host = Host(threads, means=work.splats.means)
    for _ in range(PASSES):
        with WeightStore() as store:
            start = time.perf_counter()
            with watched() as walking:
                denominators, columns = walk_regions(raster, work.views, looking, count, store)
            geometry.append((time.perf_counter() - start) / len(work.views))
            for channels, seconds in solution.items():
                books = _with_channels(columns, channels)
                start = time.perf_counter()
                with watched() as solving:
                    closed_form(store, books, denominators, torch.float16, silent, device, host)
                seconds.append((time.perf_counter() - start) / len(work.views))
                if channels not in peaks:  # a process that has solved for more keeps some of what that took
                    peaks[channels] = max(walking.bytes or peak_memory(), solving.bytes or peak_memory())
    walked = statistics.median(geometry)
    view = {channels: walked + statistics.median(seconds) for channels, seconds in solution.items()}
    held = {
        "inputs_bytes": inputs_bytes(work, USUAL),
        "features_bytes": 2 * count * USUAL,
        "peak_bytes": peaks[USUAL],
    }
    beyond = peaks[USUAL] - held["inputs_bytes"] - held["features_bytes"]
    targets = (
        (f"seconds a view, {USUAL} channels", view[USUAL], _view_seconds(work)),
        (f"a view with {MANY} channels over one with {FEW}", view[MANY] / view[FEW], CHANNELS_RATIO),
        ("MiB beyond inputs and X", beyond / 2**20, BEYOND_BYTES / 2**20),
    )
    return {
        "aims": [
            {"name": name, "found": found, "aim": aim} | ({} if aim is None else {"met": found <= aim})
            for name, found, aim in targets
        ],
        "geometry_s_per_view": walked,
        "solve_s_per_view": {str(channels): statistics.median(seconds) for channels, seconds in solution.items()},
        "load": os.getloadavg()[0],
        **held,
    }


def _view_seconds(work: Workload) -> float | None:
    camera = work.views[0][0]
    return VIEW_SECONDS.get((work.name, work.splats.count, camera.width, camera.height))


def inputs_bytes(work: Workload, channels: int) -> int:
    """Bytes of splats as a lift reads them (no colour), and of label maps and float16 codebooks of F channels."""
    splats = work.splats
    geometry = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits)
    maps = [observed for _, observed in work.views if isinstance(observed, Regions)]
    labels = sum(observed.labels.nbytes + 2 * observed.codebook.shape[0] * channels for observed in maps)
    return sum(part.nbytes for part in geometry) + labels


def _with_channels(columns: Sequence[Columns], channels: int) -> list[Columns]:
    """The same columns over unit codebooks of so many channels: what they say is of no account here."""
    books = []
    for number, part in enumerate(columns):
        drawn = torch.randn(part.codebook.shape[0], channels, generator=torch.Generator().manual_seed(number))
        books.append(replace(part, codebook=normalize(drawn, dim=1).half()))
    return books


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
    from liftcore.io.splats import read_splats

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
