"""What lifts in blocks cost, and what they hold: against a lift in memory, by Ray's workers, of a scene too large.

    python -m tests.benchmarks.engine overhead SCENE
    python -m tests.benchmarks.engine weak SCENE
    python -m tests.benchmarks.engine large [--splats N] [--channels F] [--views V]

The first prints seconds in memory, by LocalEngine, and by one and two workers of Ray. SCENE is a folder with
``point_cloud.ply``, cameras and ``regions.safetensors`` or ``features.safetensors``. The second gives one worker of
a core half of the views, and then two of them all views. The third flies over a made
city, where each view looks down on a part of it: seconds, bytes, and the memory that the process holds for itself
(RssAnon, the most of all looks; pages of mapped files may be dropped). From its costs follows the model that it
prints, of fifty million splats, ten thousand views and 512 channels on more workers.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import torch

import liftcore as lc
from liftcore.engine.blocks import SUMMED, WEIGHED
from liftcore.io.shards import ROWS
from liftcore.scene.cameras import Camera

GIB = 1 << 30
SIZE, FOCAL = (960, 720), 900.0
CITY = 4_000.0  # units of a side
HEIGHT = 300.0  # of the cameras


@contextmanager
def most_held() -> Iterator[list[int]]:
    """Bytes of RssAnon of this process at the most."""
    found, over = [0], Event()

    def look() -> None:
        while not over.wait(0.05):
            lines = Path("/proc/self/status").read_text().splitlines()
            found[0] = max(found[0], *(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon")))

    watch = Thread(target=look)
    watch.start()
    try:
        yield found
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
    made = {}
    for number in range(views):
        row, column = divmod(number, side)
        x, y = (CITY * (place + 0.5) / side for place in (column, row))
        pose = np.array([[1, 0, 0, -x], [0, -1, 0, y], [0, 0, -1, HEIGHT], [0, 0, 0, 1]], float)
        name = f"v{number:05}"
        made[name] = Camera.pinhole(name, *SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, pose)
    return lc.Cameras(made)


def maps(views: lc.Cameras, channels: int) -> Iterator[tuple[str, lc.FeatureGrid]]:
    """A feature map a view, one in memory at a time."""
    for number, name in enumerate(views):
        yield name, lc.FeatureGrid(np.random.default_rng(number).normal(0, 1, (45, 60, channels)).astype(np.float16))


def large(splats: int, channels: int, views: int, told: Any) -> None:
    """Lift the city in blocks, in a process of its own, and send what it took."""
    cameras = flight(views)
    with tempfile.TemporaryDirectory() as folder, most_held() as held:
        scene = city(splats)
        begun, before = time.perf_counter(), held[0]
        work, out = Path(folder, "blocks"), Path(folder, "lift")
        result = lc.lift(
            scene, cameras, maps(cameras, channels), preset="row-sum", engine=lc.LocalEngine(), checkpoint=work
        )
        seconds = time.perf_counter() - begun
        result.save(out)
        entries = result.diagnostics["weights_entries"]
        blocks = sum(path.stat().st_size for path in work.glob("view-*"))
        shown = result.diagnostics["plan"]["splats_a_view"]
    told.put(
        (seconds, result.metadata.timings, held[0], before, entries, blocks, shown, float(result.seen.float().mean()))
    )


def tell_large(splats: int, channels: int, views: int) -> None:
    """Print what the city took, and what follows from it."""
    context = multiprocessing.get_context("spawn")
    told = context.Queue()
    process = context.Process(target=large, args=(splats, channels, views, told))
    process.start()
    seconds, timings, held, before, entries, blocks, shown, seen = told.get()
    process.join()
    view, entry = timings["geometry"] / views, timings["solve"] / (entries * channels)
    size = "x".join(map(str, SIZE))
    print(f"{splats} splats, {views} views of {size}, {channels} channels: {seconds:.0f} s, {seen:.1%} seen")
    print("  " + ", ".join(f"{name} {took:.1f}" for name, took in timings.items()))
    print(
        f"  at most {held / GIB:.2f} GiB held, {before / GIB:.2f} of it the scene; W {blocks / GIB:.2f} GiB in files"
    )
    print(f"  {view:.2f} s and {blocks / views / 2**20:.0f} MiB a view, {shown:.0f} splats in it")
    print(f"  {entry * 1e9:.2f} ns an entry and channel")
    goal_views, goal_channels, goal_splats = 10_000, 512, 50_000_000
    walk, solve = view * goal_views, entry * entries / views * goal_views * goal_channels
    traffic = blocks / views * goal_views
    pieces = -(-goal_views // WEIGHED), -(-goal_splats // ROWS)
    print(
        f"model: {goal_splats} splats, {goal_views} such views, {goal_channels} channels (this machine as one worker)"
    )
    for workers in (1, 4, 16, 64, 256):
        rounds = -(-pieces[0] // workers) * WEIGHED * view + -(-pieces[1] // workers) * solve / pieces[1]
        sent = (2 * traffic + 2 * goal_splats * goal_channels) / workers
        print(f"  {workers:>3} workers: {rounds / 3600:.2f} h, {sent / GIB:.1f} GiB read and written by each")
    names = goal_views * pieces[1]
    print(
        f"  first to break: {names} openings of files ({goal_views} views x {pieces[1]} blocks, {SUMMED} at a time)"
    )
    print(f"  sums without waiting: {walk / 3600:.2f} h geometry, {solve / 3600:.2f} h solution")


def overhead(scene: Path, turns: int) -> None:
    """Print the seconds of the same lift in memory and in blocks, by turns."""
    pack = next(path for name in ("regions", "features") if (path := scene / f"{name}.safetensors").exists())
    splats, cameras = lc.read_splats(scene / "point_cloud.ply"), lc.read_cameras(scene)
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
            begun = time.perf_counter()
            found = lc.lift(splats, cameras, lc.read_features(pack), preset="row-sum", engine=engine)
            took[name].append(time.perf_counter() - begun)
            first = first or found
            assert torch.equal(found.features, first.features)
    base = np.median(took["in memory"][1:])
    for name, seconds in took.items():
        middle = np.median(seconds[1:])
        print(f"{name}: {middle:.2f} s, {middle / base:.2f} of a lift in memory, the same bits")


def weak(scene: Path, turns: int) -> None:
    """Print the seconds of half of the views by one worker of a core, and of all views by two."""
    ray = import_module("ray")
    pack = next(path for name in ("regions", "features") if (path := scene / f"{name}.safetensors").exists())
    splats, cameras, views = lc.read_splats(scene / "point_cloud.ply"), lc.read_cameras(scene), lc.read_features(pack)
    middles = []
    for workers in (1, 2):
        ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, _node_ip_address="127.0.0.1")
        given = {"preset": "row-sum", "engine": lc.RayEngine("auto", cpus=1), "view_stride": 3 - workers}
        found, took = lc.lift(splats, cameras, views, **given), []  # the first warms up
        for _ in range(turns):
            begun = time.perf_counter()
            found = lc.lift(splats, cameras, views, **given)
            took.append(time.perf_counter() - begun)
        ray.shutdown()
        middles.append(float(np.median(took)))
        stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in found.metadata.timings.items())
        print(f"{workers} workers, {len(found.views)} views: {middles[-1]:.2f} s ({stages})")
    print(f"twice the views by twice the workers: {middles[1] / middles[0]:.2f} of the time")


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("overhead", "weak"):
        one = commands.add_parser(name)
        one.add_argument("scene", type=Path)
        one.add_argument("--turns", type=int, default=3)
    two = commands.add_parser("large")
    two.add_argument("--splats", type=int, default=20_000_000)
    two.add_argument("--channels", type=int, default=64)
    two.add_argument("--views", type=int, default=64)
    options = parser.parse_args()
    if options.command == "overhead":
        overhead(options.scene, options.turns)
    elif options.command == "weak":
        weak(options.scene, options.turns)
    else:
        tell_large(options.splats, options.channels, options.views)


if __name__ == "__main__":
    main()
