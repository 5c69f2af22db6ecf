"""Growth of seconds and memory of a lift by ``default`` with its views, splats, levels, regions and channels.

    python -m tests.benchmarks.growth [--of NAME...] [--views N --splats P --channels F --size WxH] [--json]

One grows at a time, about a room whose views agree (`tests.benchmarks.scenes`); regions grow in maps of blocks,
on two levels. Seconds are processor seconds on two threads, without compiling; memory is the most that a stage held
beside what was there before the lift. The last row of each table has exponents, of the last value to the first: one
where a stage takes twice as long for twice as much. A stage of less than LEAST seconds has none.
"""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import torch

import liftcore as lc
from liftcore.evaluate.hardware import peak_memory
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.runtime.device import give_back_memory
from liftcore.runtime.progress import Timings
from liftcore.values.views import ViewFeatures
from tests.benchmarks.base import command_line, print_rows
from tests.benchmarks.room import room_cameras, room_splats
from tests.benchmarks.scenes import RoomSpec, observed_views

LEAST = 0.05  # CPU seconds that are measurable
MIB = 2**20
GROWING: dict[str, Sequence[float]] = {  # times the usual; of levels their number, of regions that of a view
    "views": (0.5, 1, 2, 4),
    "splats": (0.5, 1, 2, 4),
    "levels": (1, 2, 4),
    "regions": (100, 400, 1_600, 6_400),
    "channels": (0.5, 2, 8),
}


class StageCosts(Timings):
    """Processor seconds of stages, and the most memory that each held."""

    peaks: ClassVar[dict[str, int]] = {}  # bytes; of the last lift, which makes an instance of its own

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """See `Timings`."""
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        with super().stage(name):
            yield
        self.peaks[name] = max(self.peaks.get(name, 0), peak_memory() or 0)


def blocks(camera: lc.Camera, regions: int, channels: int, seed: int) -> lc.Regions:
    """A map of square blocks on two levels, together about so many, with a random vector each."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    maps, first = [], 0
    for share in (0.2, 0.8):
        side = max(1, round(math.sqrt(share * regions)))
        maps.append(first + y * side // camera.height * side + x * side // camera.width)
        first += side * side
    vectors = torch.randn(first, channels, generator=torch.Generator().manual_seed(seed))
    return lc.Regions(torch.stack(maps).int(), torch.nn.functional.normalize(vectors, dim=1).half())


def cost(scene: RoomSpec, levels: int, regions: int | None) -> dict[str, Any]:
    """Lift a room; a row of the table.

    Args:
        levels: of the labels. regions: of a map of blocks; None: what parts of the room are seen.
    """
    splats, cameras = room_splats(scene.splats), room_cameras(scene.views, *scene.size)
    views: dict[str, ViewFeatures] = {}
    if regions is None:
        for name, observed in observed_views(CpuRaster(splats), cameras, scene):
            assert isinstance(observed, lc.Regions)
            views[name] = lc.Regions(observed.labels[:levels].contiguous(), observed.codebook)
    else:
        views = {
            camera.name: blocks(camera, regions, scene.channels, number) for number, camera in enumerate(cameras)
        }
    give_back_memory()  # of the rows before
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_memory() or 0
    StageCosts.peaks.clear()
    with (
        patch("liftcore.lifting.pipeline.Timings", StageCosts),
        patch("liftcore.runtime.progress.time.perf_counter", time.process_time),
    ):
        result = lc.lift(splats, {camera.name: camera for camera in cameras}, views, threads=2, progress=False)
    seconds = {name: took for name, took in result.metadata.timings.items() if name != "compile"}
    memory = {f"{name} MiB": (peak - before) / MIB for name, peak in StageCosts.peaks.items() if name in seconds}
    entries = result.diagnostics["weights_entries"] / 1e6
    return {"million entries": entries, **seconds, "all": sum(seconds.values()), **memory}


def exponents(rows: Sequence[Mapping[str, Any]], name: str) -> dict[str, Any]:
    """Compute the exponent of each column over that of the name, from the first row to the last."""
    first, last = rows[0], rows[-1]
    factor = math.log(last[name] / first[name])
    growth: dict[str, Any] = {name: "exponent"}
    for column in list(last)[1:]:
        least = 1 if column.endswith("MiB") else LEAST
        is_known = first.get(column, 0) > 0 and last[column] >= least
        growth[column] = f"{math.log(last[column] / first[column]) / factor:.2f}" if is_known else None
    return growth


def main() -> None:
    """Print a table for each that grows."""
    parser = command_line(
        "tests.benchmarks.growth",
        __doc__,
        ("--of", {"nargs": "+", "choices": list(GROWING), "default": list(GROWING)}),
        ("--views", {"type": int, "default": 30}),
        ("--splats", {"type": int, "default": 100_000}),
        ("--channels", {"type": int, "default": 128}),
        ("--size", {"default": "320x240"}),
    )
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    cost(RoomSpec(2_000, 4, (64, 48), 8), 4, None)  # compiles
    for name in options.of:
        rows = []
        for value in GROWING[name]:
            defaults = {"views": options.views, "splats": options.splats, "channels": options.channels}
            setting = round(value * defaults[name]) if name in defaults else int(value)
            defaults |= {name: setting} if name in defaults else {}
            scene = RoomSpec(size=(width, height), cosine=0.6, **defaults)
            levels, regions = setting if name == "levels" else 4, setting if name == "regions" else None
            label = setting * options.views if regions else setting
            rows.append({name: label} | cost(scene, levels, regions))
        columns = max(rows, key=len)
        print_rows([*rows, exponents(rows, name)], as_json=options.json, columns=list(columns))


if __name__ == "__main__":
    main()
