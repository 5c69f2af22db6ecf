"""``splatlift bench --aims``: the figures that the project set itself as aims, beside what this machine does.

One walk of all views a pass, and of its W the solution with few, usual and many channels: what a channel costs is
then no matter of how busy the machine was between two runs.
"""

from __future__ import annotations

import os
import statistics
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch.nn.functional import normalize

from liftcore.evaluate.anonymous_memory import watched
from liftcore.evaluate.hardware import peak_memory
from liftcore.evaluate.region_walk import walk_regions
from liftcore.features.views import Regions
from liftcore.progress import silent
from liftcore.raster.open_raster import open_raster
from liftcore.settings import LiftSettings
from liftcore.solve.host import Host
from liftcore.solve.solver import closed_form
from liftcore.solve.view_weights import WeightStore

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.device import Device
    from liftcore.evaluate.bench import Workload
    from liftcore.settings import Preset
    from liftcore.solve.columns import Columns

CHANNELS = FEW, USUAL, MANY = 64, 512, 1024
PASSES = 3  # of which the median counts
# Aims of seconds a view, USUAL channels on two cores, by workload, splats and image.
VIEW_SECONDS = {("plush", 179_788, 990, 742): 0.15, ("synthetic room", 1_000_000, 986, 728): 0.30}
CHANNELS_RATIO = 1.1  # a view with MANY channels over one with FEW
BEYOND_BYTES = 1 << 30  # the most memory beside inputs and X
MIB = 2**20


@dataclass(frozen=True)
class Figure:
    """One figure, and the most that it aims at."""

    name: str
    found: float
    aim: float | None  # None: there is none for this workload

    @property
    def facts(self) -> dict[str, Any]:
        """Plain numbers."""
        return {"name": self.name, "found": self.found, "aim": self.aim} | (
            {} if self.aim is None else {"met": self.found <= self.aim}
        )


def measure_aims(work: Workload, preset: Preset, device: Device, threads: int | None = None) -> dict[str, Any]:
    """The aims of a lift of this workload: seconds a view, what channels cost, memory.

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
    figures = (
        Figure(f"seconds a view, {USUAL} channels", view[USUAL], _view_seconds(work)),
        Figure(f"a view with {MANY} channels over one with {FEW}", view[MANY] / view[FEW], CHANNELS_RATIO),
        Figure("MiB beyond inputs and X", beyond / MIB, BEYOND_BYTES / MIB),
    )
    return {
        "aims": [figure.facts for figure in figures],
        "geometry_s_per_view": walked,
        "solve_s_per_view": {str(channels): statistics.median(seconds) for channels, seconds in solution.items()},
        "load": os.getloadavg()[0],
        **held,
    }


def _view_seconds(work: Workload) -> float | None:
    camera = work.views[0][0]
    return VIEW_SECONDS.get((work.name, work.splats.count, camera.width, camera.height))


def lines_of(document: dict[str, Any]) -> Iterator[str]:
    """The aims for people."""
    for figure in document["aims"]:
        aim = figure["aim"]
        told = "no aim here" if aim is None else f"aim {aim:g}, {'met' if figure['met'] else 'not met'}"
        yield f"{figure['name']}: {figure['found']:.4g} ({told})"
    solved = ", ".join(f"{channels} channels {each:.4f}" for channels, each in document["solve_s_per_view"].items())
    yield f"seconds a view: geometry {document['geometry_s_per_view']:.4f}; solution {solved}"


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
