"""How long Post-Lifting Aggregation takes on a large scene, stage by stage.

    python -m liftcore.measure.aggregation_bench [--splats N] [--views V] [--size WxH] [--channels F] [--json]

The scene is the synthetic room. Its features have as many groups as the room has balls and walls, with noise of
their own for each splat; the views have four levels of regions. Wall seconds depend on what else the machine does;
processor seconds, of all threads together, hardly do.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.measure.bench import hardware
from liftcore.measure.synthetic import room_cameras, room_regions, room_splats
from liftcore.raster.cpu import CpuRaster
from liftcore.raster.warm_up import warm_up
from liftcore.solve.accumulate import render_walk
from liftcore.solve.aggregation import KeptRegions, kept_means, spread
from liftcore.solve.clustering import cluster_splats
from liftcore.solve.region_filter import match_regions
from liftcore.solve.settings import LiftSettings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

_CELL = 1.5  # scene units: splats in the same cube of this size share a feature, but for noise
_NOISE = 0.7  # length of a splat's own noise beside the unit feature of its group
_BLOCK = 65_536


class Stages:
    """Wall and processor seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, dict[str, float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the block's seconds to the stage."""
        wall, processor = time.perf_counter(), time.process_time()
        yield
        before = self.seconds.get(name, {"wall": 0.0, "processor": 0.0})
        self.seconds[name] = {
            "wall": before["wall"] + time.perf_counter() - wall,
            "processor": before["processor"] + time.process_time() - processor,
        }


def grouped_features(means: Tensor, channels: int, seed: int = 0) -> Tensor:
    """[P, F] f16: a random unit vector for each cube of space, and noise for each splat."""
    rng = np.random.default_rng(seed)
    cells = np.floor(means.numpy() / _CELL).astype(np.int64)
    groups = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    directions = rng.standard_normal((int(groups.max()) + 1, channels)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    features = torch.empty(means.shape[0], channels, dtype=torch.float16)
    for first in range(0, means.shape[0], _BLOCK):
        own = groups[first : first + _BLOCK]
        noise = rng.standard_normal((own.size, channels), dtype=np.float32) * (_NOISE / np.sqrt(channels))
        features[first : first + _BLOCK] = torch.from_numpy(directions[own] + noise)
    return features


def run(count: int, views: int, size: tuple[int, int], channels: int) -> dict[str, Any]:
    """Aggregate once and give plain numbers, ready for JSON."""
    settings = LiftSettings.of(aggregation=True)
    splats = room_splats(count)
    cameras = room_cameras(views, *size)
    observations = [room_regions(camera, k, levels=4, channels=channels) for k, camera in enumerate(cameras)]
    features = grouped_features(splats.means, channels)
    warm_up()
    importlib.import_module("hdbscan")  # what it takes to load is no part of the clustering
    raster, stages = CpuRaster(splats), Stages()
    with stages.stage("cluster"):
        clustering = cluster_splats(features, np.ones(count), settings)
    kept = KeptRegions(np.zeros((clustering.count, channels)), np.zeros(clustering.count, np.int64))
    for camera, observation in zip(cameras, observations, strict=True):
        with stages.stage("render"):
            kappa = raster.strongest_labels(camera, clustering.labels, render_walk(settings)).numpy()
        with stages.stage("contingency"):
            rows = observation.codebook.shape[0]
            matches = match_regions(observation.labels.numpy(), kappa, rows, clustering.count)
            kept.add(observation.codebook, matches.clusters, matches.clusters >= 0)  # all, for the most work
    with stages.stage("merge"):
        share = float(spread(features, clustering.labels, kept_means(kept, features.dtype)).float().mean())
    total = {key: sum(stage[key] for stage in stages.seconds.values()) for key in ("wall", "processor")}
    return {
        "splats": count, "views": views, "width": size[0], "height": size[1], "channels": channels,
        "clusters": clustering.count, "unclustered_share": float((clustering.labels < 0).float().mean()),
        "changed_share": share, "seconds": stages.seconds | {"total": total}, "hardware": hardware(),
    }  # fmt: skip


def main() -> None:
    """Print a table, or one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m liftcore.measure.aggregation_bench", description=__doc__)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", default="986x728", help="WxH in pixels")
    parser.add_argument("--channels", type=int, default=512)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args()
    width, height = (int(part) for part in options.size.split("x"))
    document = run(options.splats, options.views, (width, height), options.channels)
    if options.json:
        print(json.dumps(document))
        return
    seconds, machine = document.pop("seconds"), document.pop("hardware")
    print(", ".join(f"{key} {value}" for key, value in document.items()))
    print(f"{'stage':<14}{'wall s':>9}{'processor s':>13}")
    for name, spent in seconds.items():
        print(f"{name:<14}{spent['wall']:>9.1f}{spent['processor']:>13.1f}")
    print(", ".join(f"{key} {value}" for key, value in machine.items()))


if __name__ == "__main__":
    main()
