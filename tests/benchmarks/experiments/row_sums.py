"""Row sums of A: how close rays come to meeting the scene whole (the paper's Property 2).

A scene trained on random backgrounds is penalised for every ray that the background shines through; one trained on
black is not. Files do not say how they were trained: compare scenes, or two trainings of one scene, by running this
on each folder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.io.cameras import read_cameras
from liftcore.io.ply import read_splats
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.settings import TIKHONOV_GAIN

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from tests.benchmarks.experiments.subject import Subject

TITLE = "Row sums of A"
SOURCE = "the paper's Property 2 and its tables of row sums"
GAINS = (1.0, TIKHONOV_GAIN)
BINS = 10.0 ** np.linspace(-6, 0, 61)  # of 1 - row sum
COLUMNS = ("gain", "views", "mean", "std", "lowest_view_mean", "below_0.9", "min")


def measure(subject: Subject) -> dict[str, Any]:
    """Statistics of the row sums over every pixel of every n-th camera, without and with the opacity gain."""
    raster = CpuRaster(read_splats(subject.folder / "point_cloud.ply"))
    cameras = list(read_cameras(subject.cameras).values())[:: subject.every]
    rows, counts = [], {}
    for gain in GAINS:
        sums = [raster.row_sums(camera, CompositingParams(gain)).numpy().ravel() for camera in cameras]
        every = np.concatenate(sums).astype(np.float64)
        rows.append(
            {
                "gain": gain,
                "views": len(cameras),
                "mean": float(every.mean()),
                "std": float(every.std()),
                "lowest_view_mean": min(float(part.mean(dtype=np.float64)) for part in sums),
                "below_0.9": float((every < 0.9).mean()),
                "min": float(every.min()),
            }
        )
        missing = (1 - every).clip(BINS[0], BINS[-1])
        counts[f"gain {gain:g}"] = (np.histogram(missing, BINS)[0] / every.size).tolist()
    return {"columns": COLUMNS, "rows": rows, "bins": BINS.tolist(), "counts": counts}


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Share of the rays by what is missing to one."""
    from tests.benchmarks.experiments.figure import lines

    axes = lines(figure, "1 - row sum", "share of the rays")
    for name, counts in document["counts"].items():
        axes.stairs(counts, document["bins"], label=name)
    axes.set_xscale("log")
    axes.legend()
