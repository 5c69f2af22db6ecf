"""Wall and processor seconds of every step of a view, on one thread, of the workloads of ``splatlift bench``.

    python -m tests.benchmarks.stages [--scene DIR] [--splats N] [--size WxH] [--channels F] [--views N]

A raster that times its own steps: nothing else about it differs, so the kernels are those of every lift. On one
thread a step's processor time is its own, and near its wall time on an idle machine; how far two cores share the work
is what ``splatlift bench`` shows.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from liftcore.device import choose_device
from liftcore.evaluate.bench import Workload, workload
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.composite import Frame
from liftcore.raster.cpu.project import View
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.cpu.tiles import Bands
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook, as_regions
from liftcore.solve.weights import RegionWeights, stacked
from liftcore.warm_up import warm_up_lift
from tests.benchmarks.base import command_line, tell

STAGES = ("projection", "order", "lists", "walk", "merge", "rest", "solution")


@dataclass
class Clock:
    """Wall and processor seconds by stage, without what stages inside a stage took."""

    wall: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)
    _inner: list[list[float]] = field(default_factory=list, repr=False)  # of the open stages: wall, cpu within them

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block under that name, less the stages within it."""
        self._inner.append([0.0, 0.0])
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        spent = [time.perf_counter() - wall, time.process_time() - cpu]
        inner = self._inner.pop()
        if self._inner:
            self._inner[-1] = [mine + its for mine, its in zip(self._inner[-1], spent, strict=True)]
        self.wall[name] = self.wall.get(name, 0.0) + spent[0] - inner[0]
        self.cpu[name] = self.cpu.get(name, 0.0) + spent[1] - inner[1]


class TimedRaster(CpuRaster):
    """The CPU raster on one thread, each step of a view under its name in ``clock``."""

    def __init__(self, splats: Splats) -> None:
        super().__init__(splats, threads=1)
        self.clock = Clock()
        self._projecting = False

    def _project(self, view: View, params: CompositingParams) -> tuple[np.ndarray, np.ndarray]:
        with self.clock.stage("order"):  # what it does beside its shares of splats
            self._projecting = True
            return super()._project(view, params)

    def _map(self, work: Callable, shares: list) -> list:
        if not self._projecting:
            return super()._map(work, shares)
        self._projecting = False
        with self.clock.stage("projection"):
            return super()._map(work, shares)

    def _bin(self, view: View, params: CompositingParams, ids: np.ndarray, order: np.ndarray) -> Bands:
        with self.clock.stage("lists"):
            return super()._bin(view, params, ids, order)

    def _over_tiles(self, frame: Frame, work: Callable) -> list:
        with self.clock.stage("walk"):
            return super()._over_tiles(frame, work)

    def _merge(self, frame: Frame, entries: list, codebook_rows: int) -> RegionWeights:
        with self.clock.stage("merge"):
            return super()._merge(frame, entries, codebook_rows)


def time_stages(work: Workload, preset: Preset) -> dict[str, Any]:
    """Seconds a view of each of STAGES on one thread: medians and minima over the views; the solution once for all.

    ``rest`` is what a view takes beside the named steps: its tuples of labels and its reading.
    """
    settings = LiftSettings.of(preset=preset)
    raster, walk, weighting = TimedRaster(work.splats), settings.lift_params, settings.weighting
    parts, views, codebooks = [], [], []
    raster.region_weights(*work.views[0], walk, weighting)  # warm caches, not counted
    for camera, observation in work.views:
        raster.forget()
        raster.clock = Clock()
        with raster.clock.stage("rest"):
            regions, own = as_regions(observation, by_rows=False)
            parts.append(own.counted(raster.region_weights(camera, regions, walk, weighting)))
        codebooks.append(own)
        views.append(raster.clock)
    clock = Clock()
    with clock.stage("solution"):
        W = stacked(parts, work.splats.count, threads=1)
        solve(W, Codebook(tuple(codebooks)), torch.float16, means=work.splats.means, threads=1)
    share = 1 / len(views)
    solution = Clock({"solution": clock.wall["solution"] * share}, {"solution": clock.cpu["solution"] * share})
    return {
        "threads": 1,
        "load": os.getloadavg()[0],
        "stages": {name: _figures(name, [solution] if name == "solution" else views) for name in STAGES},
    }


def _figures(name: str, clocks: list[Clock]) -> dict[str, float]:
    wall, cpu = [clock.wall[name] for clock in clocks], [clock.cpu[name] for clock in clocks]
    return {
        "wall_s": statistics.median(wall),
        "wall_s_min": min(wall),
        "cpu_s": statistics.median(cpu),
        "cpu_s_min": min(cpu),
    }


def main() -> None:
    """Time a workload."""
    sizes = [(f"--{name}", {"type": int}) for name in ("splats", "channels", "levels", "views")]
    names = [(f"--{name}", {}) for name in ("scene", "size", "preset")]
    options = vars(command_line("tests.benchmarks.stages", __doc__, *sizes, *names).parse_args())
    work, presets = workload(options), [options["preset"]] if options["preset"] else ["row-sum", "tikhonov"]
    warm_up_lift(work.splats.kernel, choose_device("cpu"), LiftSettings.of(preset="row-sum"))
    rows = []
    for preset in presets:
        found = time_stages(work, LiftSettings.of(preset=preset).preset)
        rows += [{"preset": preset, "step": name, **figures} for name, figures in found["stages"].items()]
    sizes = f"{work.splats.count} splats, {len(work.views)} views"
    note = f"{work.name}, {sizes}; seconds a view; load {os.getloadavg()[0]:.1f}"
    tell(rows, as_json=options["json"], note=note)


if __name__ == "__main__":
    main()
