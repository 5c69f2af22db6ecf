"""A lift of maps with a vector a pixel: processor seconds of its stages, and the memory that it held and planned.

    python -m tests.benchmarks.dense FOLDER [--views N] [--channels F] [--presets NAME...] [--json]

FOLDER has splats, cameras and ``images``, as that of `plush`. The vector of a pixel is made of cosines of random
projections of its colour, so that views agree. Seconds are on two threads, without compiling. Memory is private
(RssAnon), as maps and W lie in mapped files: the most of samples twenty times a second, beside what was held before.
"""

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from PIL import Image

import liftcore as lc
from liftcore.scene.cameras import Camera
from liftcore.values.pack import as_views
from liftcore.values.views import FeatureGrid, ViewFeatures
from tests.benchmarks.base import command_line, print_rows, read_scene

MIB = 2**20
INTERVAL = 0.05  # seconds between two samples of the memory


def pixel_maps(folder: Path, cameras: list[Camera], channels: int) -> Iterator[tuple[str, ViewFeatures]]:
    """Iterate over views by name, each a grid [height, width, channels] f16 of its photo."""
    generator = torch.Generator().manual_seed(0)
    directions, phases = torch.randn(3, channels, generator=generator), torch.rand(channels, generator=generator)
    photos = {path.stem: path for path in (folder / "images").iterdir()}
    for camera in cameras:
        with Image.open(photos[Path(camera.name).stem]) as photo:
            pixels = np.asarray(photo.convert("RGB").resize((camera.width, camera.height)), np.float32) / 255
        grid = torch.empty(camera.height, camera.width, channels, dtype=torch.float16)
        for row in range(camera.height):
            grid[row] = torch.cos(torch.from_numpy(pixels[row]) @ directions + 6.2832 * phases)
        yield camera.name, FeatureGrid(grid)


def private_bytes() -> int:
    """Return the private memory of this process."""
    line = re.search(r"RssAnon:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    return int(line[1]) * 1024 if line else 0


@contextmanager
def sampled_memory() -> Iterator[list[int]]:
    """Yield a list of one number: the most private memory in bytes while the block runs, beside that before it."""
    before, most, stop = private_bytes(), [0], threading.Event()

    def sample() -> None:
        while not stop.wait(INTERVAL):
            most[0] = max(most[0], private_bytes() - before)

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield most
    finally:
        stop.set()
        thread.join()


def main() -> None:
    """Print the table."""
    parser = command_line(
        "tests.benchmarks.dense",
        __doc__,
        ("folder", {"type": Path}),
        ("--views", {"type": int, "default": 2}),
        ("--channels", {"type": int, "default": 512}),
        ("--presets", {"nargs": "+", "default": ["default", "row-sum"]}),
    )
    options = parser.parse_args()
    splats, scene_cameras = read_scene(options.folder)
    photos = {path.stem for path in (options.folder / "images").iterdir()}
    cameras = [camera for camera in scene_cameras.values() if Path(camera.name).stem in photos]
    cameras = cameras[:: -(-len(cameras) // options.views)]
    views = as_views(pixel_maps(options.folder, cameras, options.channels))
    rows = []
    for preset in options.presets:
        settings = lc.LiftSettings.of(preset=preset, device="cpu")
        with patch("liftcore.runtime.progress.time.perf_counter", time.process_time), sampled_memory() as most:
            result = lc.lift(splats, scene_cameras, views, settings, threads=2, progress=False)
        seconds = {name: took for name, took in result.metadata.timings.items() if name != "compile"}
        rows.append(
            {
                "preset": preset,
                "views": len(cameras),
                "million entries a view": result.diagnostics["weights_entries"] / len(cameras) / 1e6,
                **seconds,
                "all": sum(seconds.values()),
                "held MiB": most[0] / MIB,
                "planned MiB": result.diagnostics["plan"]["memory_bytes"] / MIB,
            }
        )
    print_rows(rows, as_json=options.json, columns=list(max(rows, key=len)))


if __name__ == "__main__":
    main()
