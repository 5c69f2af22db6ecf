"""Time and memory of lifts in blocks: against a lift in memory, by Ray's workers, of a scene too large.

    python -m tests.benchmarks.engine overhead SCENE [--preset P]
    python -m tests.benchmarks.engine weak SCENE [--preset P]
    python -m tests.benchmarks.engine large [--splats N] [--channels F] [--views V] [--preset P]

The preset is `default` where none is named. The first prints seconds in memory, by LocalEngine, and by one and two
workers of Ray. SCENE is a folder with ``point_cloud.ply``, cameras and ``regions.safetensors`` or
``features.safetensors``. The second gives one worker of a core half of the views, and then two of them all views. The
third flies over a made city, where each view looks down on a part of it and has masks of plots on four levels:
seconds, bytes, and the memory that the process holds for itself (RssAnon, the most of all looks; pages of mapped
files may be dropped). From its costs follows the model that it prints, of fifty million splats, ten thousand views
and 512 channels on more workers.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
import torch

import liftcore as lc
from liftcore.io.shards import ROWS
from liftcore.lifting.engines.blocks import PIECE_VIEWS
from liftcore.values.views import ViewFeatures
from tests.benchmarks.base import read_pack, read_scene

GIB = 1 << 30
SIZE, FOCAL = (960, 720), 900.0
CITY = 4_000.0  # units of a side
HEIGHT = 300.0  # of the cameras
FILE_OPENS = (
    7  # times that a block of splats opens the files of a piece of views: W three times, tuples and shares twice
)
PLOTS = (8, 16, 40, 80)  # units of a side, of each level


@contextmanager
def peak_memory_of() -> Iterator[list[int]]:
    """Bytes of RssAnon of this process at the most."""
    peak, over = [0], Event()

    def sample() -> None:
        while not over.wait(0.05):
            lines = Path("/proc/self/status").read_text().splitlines()
            peak[0] = max(peak[0], *(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon")))

    watch = Thread(target=sample)
    watch.start()
    try:
        yield peak
    finally:
        over.set()
        watch.join()


def city(splats: int, seed: int = 0) -> lc.Splats:
    """Flat splats on streets and walls of a square city, most of them opaque."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(0, CITY, (splats, 3)).astype(np.float32)
    means[:, 2] = rng.exponential(12.0, splats)
    size = np.log(CITY / np.sqrt(splats))
    log_scales = rng.normal(size, 0.3, (splats, 3)).astype(np.float32)
    log_scales[:, 2] -= 2.0
    quats = rng.normal(0, 0.2, (splats, 4)).astype(np.float32)
    quats[:, 0] = 1.0
    return lc.Splats(means, quats, log_scales, rng.normal(2, 1, splats).astype(np.float32))


def flight(views: int) -> lc.Cameras:
    """Cameras on lines over the city, which look down."""
    side = int(np.ceil(np.sqrt(views)))
    rows = {}
    for number in range(views):
        row, column = divmod(number, side)
        x, y = (CITY * (place + 0.5) / side for place in (column, row))
        pose = np.array([[1, 0, 0, -x], [0, -1, 0, y], [0, 0, -1, HEIGHT], [0, 0, 0, 1]], float)
        name = f"v{number:05}"
        rows[name] = lc.Camera.pinhole(name, *SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, pose)
    return lc.Cameras(rows)


def plots(views: lc.Cameras, channels: int) -> Iterator[tuple[str, lc.Regions]]:
    """Masks of square plots of the ground on four levels, with a vector a plot; one view in memory at a time."""
    for name, camera in views.items():
        corner, width, height = np.linalg.inv(camera.viewmat)[:2, 3], SIZE[0] // 2, SIZE[1] // 2
        across = (np.arange(width) * 2 + 1 - SIZE[0] / 2) * HEIGHT / FOCAL
        down = (np.arange(height) * 2 + 1 - SIZE[1] / 2) * HEIGHT / FOCAL
        x, y = corner[0] + across, corner[1] - down  # the camera's y axis is the city's turned round
        labels, vectors, count = [], [], 0
        for side in PLOTS:
            cells = np.stack(np.broadcast_arrays(*np.meshgrid(x // side, y // side)), axis=-1).astype(np.int64)
            occupied, label = np.unique(cells.reshape(-1, 2), axis=0, return_inverse=True)
            labels.append(count + label.reshape(height, width))
            seeds = [np.random.default_rng([side, *(cell + 1000).tolist()]) for cell in occupied]
            vectors.append(np.stack([seed.normal(size=channels) for seed in seeds]))
            count += len(occupied)
        yield name, lc.Regions(np.stack(labels).astype(np.int32), np.concatenate(vectors).astype(np.float16))


class Cost(NamedTuple):
    """The cost of a lift of the city."""

    seconds: float
    timings: dict[str, float]  # seconds by stage
    peak_bytes: int  # bytes at the most
    scene: int  # of them those of the scene
    entries: int  # of W
    blocks: int  # bytes of W in files
    splats_a_view: float  # splats in a view
    visible_share: float  # share of the splats


def large(splats: int, channels: int, views: int, preset: str) -> Cost:
    """Lift the city in blocks."""
    cameras = flight(views)
    with tempfile.TemporaryDirectory() as folder, peak_memory_of() as peak:
        scene = city(splats)
        start, before = time.perf_counter(), peak[0]
        work = Path(folder, "blocks")
        options = {"preset": preset, "engine": lc.LocalEngine(), "checkpoint": work}
        result = lc.lift(scene, cameras, plots(cameras, channels), **options)
        seconds = time.perf_counter() - start
        result.save(Path(folder, "lift"))
        entries, splats_a_view = result.diagnostics["weights_entries"], result.diagnostics["plan"]["splats_a_view"]
        blocks = sum(path.stat().st_size for path in work.rglob("weights-*"))
    visible_share = float(result.has_feature.float().mean())
    return Cost(seconds, result.metadata.timings, peak[0], before, entries, blocks, splats_a_view, visible_share)


def print_large(splats: int, channels: int, views: int, preset: str) -> None:
    """Print what the city took, in a process of its own, and what follows from it."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        cost = pool.submit(large, splats, channels, views, preset).result()
    view, entry = cost.timings["geometry"] / views, cost.timings["solve"] / (cost.entries * channels)
    size = "x".join(map(str, SIZE))
    print(f"{preset}: {splats} splats, {views} views of {size}, {channels} channels: {cost.seconds:.0f} s, "
          f"{cost.visible_share:.1%} seen")  # fmt: skip
    print("  " + ", ".join(f"{name} {took:.1f}" for name, took in cost.timings.items()))
    print(f"  at most {cost.peak_bytes / GIB:.2f} GiB held, {cost.scene / GIB:.2f} of it the scene; "
          f"W {cost.blocks / GIB:.2f} GiB in files")  # fmt: skip
    print(f"  {view:.2f} s and {cost.blocks / views / 2**20:.0f} MiB a view, {cost.splats_a_view:.0f} splats in it")
    print(f"  {entry * 1e9:.2f} ns an entry and channel")
    goal_views, goal_channels, goal_splats = 10_000, 512, 50_000_000
    view_seconds, solve = view * goal_views, entry * cost.entries / views * goal_views * goal_channels
    traffic = 2 * cost.blocks / views * goal_views + 2 * goal_splats * goal_channels
    parts, blocks = -(-goal_views // PIECE_VIEWS), -(-goal_splats // ROWS)
    print(f"model: {goal_splats} splats, {goal_views} such views, {goal_channels} channels "
          "(this machine as one worker)")  # fmt: skip
    for workers in (1, 4, 16, 64, 256):
        rounds = -(-parts // workers) * PIECE_VIEWS * view + -(-blocks // workers) * solve / blocks
        traffic_seconds = traffic / workers / GIB
        print(f"  {workers:>3} workers: {rounds / 3600:.2f} h, {traffic_seconds:.1f} GiB read and written by each")
    opens = FILE_OPENS * parts * blocks
    print(
        f"  first to break: {opens} openings of files ({FILE_OPENS} x {parts} pieces of views x {blocks} of splats)"
    )
    print(f"  sums without waiting: {view_seconds / 3600:.2f} h geometry, {solve / 3600:.2f} h solution")


def read(folder: Path) -> tuple[lc.Splats, lc.Cameras, Mapping[str, ViewFeatures]]:
    """A scene folder with the pack ``regions`` or else ``features``."""
    pack = "regions" if (folder / "regions.safetensors").exists() else "features"
    return *read_scene(folder), read_pack(folder, pack)


def timed(scene: tuple[Any, ...], **options: Any) -> tuple[float, lc.LiftResult]:
    """Seconds of a lift, and what it gave."""
    start = time.perf_counter()
    result = lc.lift(*scene, **options)
    return time.perf_counter() - start, result


def overhead(folder: Path, turns: int, preset: str) -> None:
    """Print the seconds of the same lift in memory and in blocks, by turns."""
    scene = read(folder)
    engines: dict[str, Any] = {"in memory": None, "LocalEngine": lc.LocalEngine()}
    try:
        engines |= {
            "Ray, 1 worker of 2 cores": lc.RayEngine(cpus=2),
            "Ray, 2 workers of 1 core": lc.RayEngine(cpus=1),
        }
    except lc.Unavailable as error:
        print(f"without Ray: {error}")
    took: dict[str, list[float]] = {name: [] for name in engines}
    first = None
    for _ in range(turns + 1):  # the first warms up
        for name, engine in engines.items():
            seconds, result = timed(scene, engine=engine, preset=preset)
            took[name].append(seconds)
            first = first or result
            assert torch.equal(result.features, first.features)
    middles = {name: np.median(seconds[1:]) for name, seconds in took.items()}
    for name, middle in middles.items():
        print(f"{name}: {middle:.2f} s, {middle / middles['in memory']:.2f} of a lift in memory, the same bits")


def weak(folder: Path, turns: int, preset: str) -> None:
    """Print the seconds of half of the views by one worker of a core, and of all views by two."""
    ray, scene, middles = import_module("ray"), read(folder), []
    for workers in (1, 2):
        ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, _node_ip_address="127.0.0.1")
        options = {"engine": lc.RayEngine("auto", cpus=1), "view_stride": 3 - workers, "preset": preset}
        took = [timed(scene, **options) for _ in range(turns + 1)][1:]  # the first warms up
        ray.shutdown()
        middles.append(float(np.median([seconds for seconds, _ in took])))
        result = took[-1][1]
        stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in result.metadata.timings.items())
        print(f"{workers} workers, {len(result.views)} views: {middles[-1]:.2f} s ({stages})")
    print(f"twice the views by twice the workers: {middles[1] / middles[0]:.2f} of the time")


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for run in (overhead, weak):
        command = commands.add_parser(run.__name__)
        command.add_argument("folder", type=Path, metavar="SCENE")
        command.add_argument("--turns", type=int, default=3)
        command.add_argument("--preset", default="default")
        command.set_defaults(run=run)
    two = commands.add_parser("large")
    for name, default in (("splats", 20_000_000), ("channels", 64), ("views", 64)):
        two.add_argument(f"--{name}", type=int, default=default)
    two.add_argument("--preset", default="default")
    two.set_defaults(run=print_large)
    options = vars(parser.parse_args())
    options.pop("run")(**options)


if __name__ == "__main__":
    main()
