"""Aggregation near thin and small objects: a sword, a ring and a nut, of steel like the kettle near them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import view_mask
from liftcore.query.scene import Scene
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.text.table import TableEncoder
from tests.benchmarks.base import mask_iou
from tests.still_life.masks import Mistakes, observe, true_labels
from tests.still_life.objects import small_things
from tests.still_life.scene import StillLife, still_life

pytestmark = pytest.mark.slow

SMALL = ("sword", "ring", "nut")
FEW = Mistakes(merged=0.1, split=0.05, misnamed=0.05, unlabelled=0.03, displacement=0.7, noise=0.35)


class Observed:
    """The scene, its views and its words; vectors of steel objects are similar."""

    def __init__(self) -> None:
        self.still_life: StillLife = still_life(views=10, pieces=small_things())
        self.raster = CpuRaster(self.still_life.splats)
        rows = np.random.default_rng(0).standard_normal((len(self.still_life.objects) + 1, 64)).astype(np.float32)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        vectors = rows[1:] + [[0.7 * (label in SMALL)] for label in self.still_life.objects] * rows[:1]
        vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
        self.encoder = TableEncoder("words", list(self.still_life.objects), vectors)
        self.views = observe(self.still_life, self.raster, self.encoder, FEW, seed=1)
        self.truth = {
            view: torch.from_numpy(true_labels(self.still_life, self.raster, view)[0])
            for view in self.still_life.held_out
        }

    def ious(self, **settings: Any) -> dict[str, float]:
        """Return the mean IoU of each object's mask in the held-out views, queried by its word."""
        result = lc.lift(
            self.still_life.splats,
            self.still_life.cameras,
            self.views,
            preset="default",
            diagnostic_rays=0,
            **settings,
        )
        scene = Scene(result, self.still_life.splats, self.still_life.cameras)
        scene.raster = self.raster
        return {
            label: float(np.mean([self._iou(scene, label, view) for view in self.truth]))
            for label in self.still_life.objects
        }

    def _iou(self, scene: Scene, label: str, view: str) -> float:
        mask = view_mask(scene, ask(scene, Query.of((label,), absent="keep"), self.encoder), view).mask
        return mask_iou(mask, self.truth[view] == self.still_life.objects.index(label))


@pytest.fixture(scope="module")
def scene() -> Observed:
    return Observed()


@pytest.mark.parametrize("clusters", ["hdbscan", "graph"])
def test_small_things_keep_their_masks_where_the_guard_stands(scene: Observed, clusters: str) -> None:
    # In two channels steel is one cluster, of which the sword has most.
    merged = {"aggregation": True, "aggregation_clusters": clusters, "aggregation_channels": 2}
    with_guard = scene.ious(**merged)
    assert min(with_guard.values()) > 0.85
    if clusters == "hdbscan":
        without_guard = scene.ious(**merged, aggregation_guard=False)
        # It is the guard that keeps them.
        assert without_guard["sword"] < 0.85 and max(without_guard["ring"], without_guard["nut"]) < 0.1
