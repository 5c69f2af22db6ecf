"""Selections: each edit against its slow definition, undo and redo, and queries of a selection."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from liftcore.query.scene import Scene
from liftcore.query.selections import area_mask
from liftcore.query.terms import Area
from liftcore.raster.reference import ReferenceRaster
from liftcore.scene.cameras import Camera
from liftcore.scene.touching import touching_pairs
from tests.tiny_scene import SPLATS_A_CLUSTER as OF_A_CLUSTER

ALL = np.arange(3 * OF_A_CLUSTER)


def rows_of(splats: np.ndarray) -> list[int]:
    return np.flatnonzero(splats).tolist()


def cluster(number: int) -> np.ndarray:
    return np.repeat(np.arange(3) == number, OF_A_CLUSTER)


@pytest.mark.parametrize("radius", [0.5, 1.0, 2.0, 5.3, 40.0])
def test_stroke_marks_the_pixels_within_its_radius(radius: float) -> None:
    random = np.random.default_rng(int(radius * 10))
    for _ in range(30):
        width, height = random.integers(1, 50, 2).tolist()
        corners = random.integers(-30, 70, (random.integers(2, 5), 2)).tolist()
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        far = np.full((height, width), np.inf)
        for (ax, ay), (bx, by) in pairwise(corners):
            way = np.array([bx - ax, by - ay], np.float64)
            share = np.clip(((x - ax) * way[0] + (y - ay) * way[1]) / max(way @ way, 1.0), 0, 1)
            far = np.minimum(far, np.hypot(x - ax - share * way[0], y - ay - share * way[1]))
        mask = area_mask(Area("view", "stroke", tuple(map(tuple, corners))), (width, height), radius)
        off_the_edge = np.abs(far - radius) > 1e-5
        assert (mask == (far <= radius))[off_the_edge].all() and mask[far == radius].all()


def test_area_takes_the_splats_whose_centres_are_seen_there(scene: Scene) -> None:
    # By the definition in float64: a dense A has the splat at which a ray's accumulated weight reaches 0.75.
    from_the_left = [[0, 0, 1, 4], [0, -1, 0, 0], [1, 0, 0, 5], [0, 0, 0, 1]]  # one cluster behind the other
    camera = Camera.pinhole("camera", 32, 24, 60, 60, 16, 12, from_the_left)
    area = "camera:box:12,2,19,20"
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    mask = (x >= 12) & (x < 19) & (y >= 2) & (y < 20)
    places = scene.splats.means.numpy().astype(np.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    columns = np.floor(places[:, 0] / places[:, 2] * camera.fx + camera.cx).astype(int)
    lines = np.floor(places[:, 1] / places[:, 2] * camera.fy + camera.cy).astype(int)
    pixels = torch.tensor(np.stack([columns, lines], axis=1), dtype=torch.int32)
    rays = ReferenceRaster(scene.splats).ray_rows(camera, pixels, scene.compositing)
    expected, through = list[int](), list[int]()
    for splat in ALL:
        if not mask[lines[splat], columns[splat]]:
            continue
        through.append(int(splat))
        ray = slice(int(rays.indptr[splat]), int(rays.indptr[splat + 1]))
        on_ray, weights = rays.splats[ray].numpy(), rays.weights[ray].double().numpy()
        deep = [at for at in places[on_ray, 2] if weights[places[on_ray, 2] <= at].sum() >= 0.75]
        near = places[splat, 2] - 2 * np.exp(scene.splats.log_scales[splat, 0].item())  # they are round
        expected += [int(splat)] if near <= min(deep, default=np.inf) else []
    selection = scene.select("mine").edit("set", area=area, radius=3, camera=camera)
    assert rows_of(selection.splats) == expected and 0 < len(expected) < len(through) < len(ALL)
    assert rows_of(selection.edit("set", area=area, radius=3, camera=camera, through=True).splats) == through


def test_selection_grows_and_shrinks_by_splats_that_touch(scene: Scene) -> None:
    first, second = touching_pairs(scene.splats, ALL)
    pairs = {(int(a), int(b)) for p, q in zip(first, second, strict=True) for a, b in ((p, q), (q, p))}
    seed = ALL == 30
    selection = scene.select("mine", seed).edit("grow", steps=2)
    expected = {30}
    for _ in range(2):
        expected |= {b for a, b in pairs if a in expected}
    assert set(rows_of(selection.splats)) == expected and 1 < len(expected) < len(ALL)
    selection.edit("shrink")
    assert set(rows_of(selection.splats)) == {a for a in expected if all(b in expected for x, b in pairs if x == a)}
    complete = scene.select("mine", cluster(1)).edit("grow", steps=100)
    assert rows_of(complete.splats) == rows_of(cluster(1))  # the clusters lie apart
