"""Single levels, and maps of distorted photos resampled to a pinhole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import Camera, Cameras, behind_lens
from liftcore.scene.distortion import Brown, Distortion, Fisheye
from liftcore.values.lens import as_pinhole_sees
from liftcore.values.levels import at_levels
from liftcore.values.pack import pair, read_features, write_pack
from liftcore.values.views import FeatureGrid, Regions
from tests.scenes import random_grid, random_regions


def test_one_level_is_that_level_alone_and_all_else_stays_as_it_is():
    regions, grid = random_regions(1, 3), random_grid(1)
    result = at_levels(regions, 2, "v0")
    assert isinstance(result, Regions)
    assert torch.equal(result.labels, regions.labels[2:]) and result.codebook is regions.codebook
    assert at_levels(regions, "rows", "v0") is regions
    assert all(at_levels(grid, levels, "v0") is grid for levels in ("rows", 0))


BARREL = Brown(k1=-0.25, k2=0.04, p1=0.002, p2=-0.001)
PINCUSHION = Brown(k1=0.2)
WIDE = Fisheye(k1=0.02)


def camera(distortion: Distortion, name: str = "v") -> Camera:
    return behind_lens(Camera.pinhole(name, 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4)), distortion)


def photo_place(view: Camera, row: float, column: float) -> tuple[float, float]:
    """Return x and y on the photo, in 0..1, of the ray through a row and a column of the pinhole image."""
    assert view.lens is not None
    x, y = np.array([(column - view.cx) / view.fx]), np.array([(row - view.cy) / view.fy])
    u, v = view.lens.on_photo(x, y)
    return float(u[0]) / view.lens.width, float(v[0]) / view.lens.height


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION, WIDE])
@pytest.mark.parametrize("size", [(44, 60), (88, 120), (9, 7)])
def test_a_pixel_reads_the_label_that_the_photo_has_where_its_ray_lies(
    distortion: Distortion, size: tuple[int, int]
) -> None:
    view, rng = camera(distortion), np.random.default_rng(1)
    labels = torch.tensor(rng.integers(-1, 9, (3, *size)), dtype=torch.int32)
    observation = as_pinhole_sees(Regions(labels, torch.ones(9, 2)), view)
    assert isinstance(observation, Regions)
    assert observation.labels.dtype == torch.int32
    assert observation.labels.shape == (3, view.height, view.width)
    for row in range(0, view.height, 3):
        for column in range(0, view.width, 3):
            x, y = photo_place(view, row + 0.5, column + 0.5)
            expected = labels[:, int(y * size[0]), int(x * size[1])]
            assert torch.equal(observation.labels[:, row, column], expected)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION, WIDE])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_a_cell_reads_the_grid_where_its_ray_lies(distortion: Distortion, dtype: torch.dtype) -> None:
    view = camera(distortion)
    y, x = torch.meshgrid((torch.arange(11) + 0.5) / 11, (torch.arange(15) + 0.5) / 15, indexing="ij")
    grid = torch.stack([x, y, torch.ones_like(x)], dim=2).to(dtype)  # which is linear between its centres
    observation = as_pinhole_sees(FeatureGrid(grid), view)
    assert isinstance(observation, FeatureGrid)
    assert observation.grid.dtype == dtype
    rows, columns = observation.grid.shape[:2]
    assert (rows, columns) == (round(11 * view.height / 44), round(15 * view.width / 60))
    for r in range(rows):
        for c in range(columns):
            place = photo_place(view, (r + 0.5) * view.height / rows, (c + 0.5) * view.width / columns)
            expected = [np.clip(place[0], 0.5 / 15, 14.5 / 15), np.clip(place[1], 0.5 / 11, 10.5 / 11), 1.0]
            tolerance = 1e-3 if dtype == torch.float16 else 1e-6
            assert np.abs(observation.grid[r, c].double().numpy() - expected).max() < tolerance


def test_packs_tell_before_a_map_is_read_what_size_it_will_have(tmp_path: Path) -> None:
    maps = {
        "bent": Regions(torch.zeros(2, 22, 30, dtype=torch.int32), torch.ones(1, 3)),
        "cells": FeatureGrid(torch.ones(11, 15, 3)),
        "plain": Regions(torch.zeros(1, 22, 30, dtype=torch.int32), torch.ones(1, 3)),
    }
    write_pack(tmp_path / "f.safetensors", maps, {})
    pinhole = Camera.pinhole("plain", 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4))
    cameras = Cameras((camera(BARREL, "bent"), camera(PINCUSHION, "cells"), pinhole))
    packs, unpaired = pair(read_features(tmp_path / "f.safetensors"), cameras)
    assert unpaired == []
    for name in maps:
        specs, observation = packs.specs(name), packs[name]
        part = observation.labels if isinstance(observation, Regions) else observation.grid
        assert next(iter(specs.values())).shape == part.shape
    assert packs["bent"].codebook.shape == (1, 3)
    assert [packs.map_size(name) for name in maps] == [(30, 22), (15, 11), (30, 22)]  # of the photos, as they lie
    assert tuple(packs.specs("plain")["labels"].shape) == (1, 22, 30)


def test_masks_in_place_of_labels_are_refused_with_a_way_on() -> None:
    labels = np.arange(12).reshape(3, 4) % 3
    planes = labels == np.arange(3)[:, None, None]
    for masks in (planes, planes.astype(np.uint8)):
        with pytest.raises(InvalidFeatures, match=r"labels: .*Regions\.from_masks\(masks"):
            Regions(masks, np.eye(3, dtype=np.float32))
    assert Regions(labels[..., None], np.eye(3, dtype=np.float32)).labels.tolist() == [labels.tolist()]
