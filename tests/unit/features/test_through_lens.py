"""What a pinhole sees of a distorted photo's maps: the label of the same ray, the grid at the same place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.features import lens
from liftcore.features.lens import as_pinhole_sees
from liftcore.features.pack import pair, read_features, write_pack
from liftcore.features.views import FeatureGrid, Regions
from liftcore.scene.cameras import Camera, Cameras, behind_lens
from liftcore.scene.distortion import Brown, Distortion, Fisheye

BARREL = Brown(k1=-0.25, k2=0.04, p1=0.002, p2=-0.001)
PINCUSHION = Brown(k1=0.2)
WIDE = Fisheye(k1=0.02)


def camera(distortion: Distortion, name: str = "v") -> Camera:
    return behind_lens(Camera.pinhole(name, 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4)), distortion)


def photo_place(view: Camera, row: float, column: float) -> tuple[float, float]:
    """Where on the photo, from 0 to 1 in x and in y, the ray of a place on the pinhole lies."""
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
    seen = as_pinhole_sees(Regions(labels, torch.ones(9, 2)), view)
    assert isinstance(seen, Regions)
    assert seen.labels.dtype == torch.int32
    assert seen.labels.shape == (3, view.height, view.width)
    for row in range(0, view.height, 3):
        for column in range(0, view.width, 3):
            x, y = photo_place(view, row + 0.5, column + 0.5)
            wanted = labels[:, int(y * size[0]), int(x * size[1])]
            assert torch.equal(seen.labels[:, row, column], wanted)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION, WIDE])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_a_cell_reads_the_grid_where_its_ray_lies(distortion: Distortion, dtype: torch.dtype) -> None:
    view = camera(distortion)
    y, x = torch.meshgrid((torch.arange(11) + 0.5) / 11, (torch.arange(15) + 0.5) / 15, indexing="ij")
    grid = torch.stack([x, y, torch.ones_like(x)], dim=2).to(dtype)  # which is linear between its centres
    seen = as_pinhole_sees(FeatureGrid(grid), view)
    assert isinstance(seen, FeatureGrid)
    assert seen.grid.dtype == dtype
    rows, columns = seen.grid.shape[:2]
    assert (rows, columns) == (round(11 * view.height / 44), round(15 * view.width / 60))
    for r in range(rows):
        for c in range(columns):
            place = photo_place(view, (r + 0.5) * view.height / rows, (c + 0.5) * view.width / columns)
            wanted = [np.clip(place[0], 0.5 / 15, 14.5 / 15), np.clip(place[1], 0.5 / 11, 10.5 / 11), 1.0]
            tolerance = 1e-3 if dtype == torch.float16 else 1e-6
            assert np.abs(seen.grid[r, c].double().numpy() - wanted).max() < tolerance


def test_large_grids_are_carried_in_bands_to_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    view, grid = camera(BARREL), FeatureGrid(torch.rand(11, 15, 4, generator=torch.Generator().manual_seed(0)))
    whole = as_pinhole_sees(grid, view)
    monkeypatch.setattr("liftcore.features.lens.BAND_VALUES", 1)
    parts = as_pinhole_sees(grid, view)
    assert isinstance(whole, FeatureGrid)
    assert isinstance(parts, FeatureGrid)
    assert torch.equal(whole.grid, parts.grid)


def test_what_has_no_lens_is_seen_as_it_is() -> None:
    view = Camera.pinhole("v", 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4))
    observation = Regions(torch.zeros(1, 4, 5, dtype=torch.int32), torch.ones(1, 2))
    assert as_pinhole_sees(observation, view) is observation


def test_packs_tell_before_a_map_is_read_what_size_it_will_have(tmp_path: Path) -> None:
    maps = {
        "bent": Regions(torch.zeros(2, 22, 30, dtype=torch.int32), torch.ones(1, 3)),
        "cells": FeatureGrid(torch.ones(11, 15, 3)),
        "plain": Regions(torch.zeros(1, 22, 30, dtype=torch.int32), torch.ones(1, 3)),
    }
    write_pack(tmp_path / "f.safetensors", maps, {})
    plain = Camera.pinhole("plain", 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4))
    cameras = Cameras((camera(BARREL, "bent"), camera(PINCUSHION, "cells"), plain))
    packs, unpaired = pair(read_features(tmp_path / "f.safetensors"), cameras)
    assert unpaired == []
    for name in maps:
        specs, observation = packs.specs(name), packs[name]
        part = observation.labels if isinstance(observation, Regions) else observation.grid
        assert next(iter(specs.values())).shape == part.shape
    assert packs["bent"].codebook.shape == (1, 3)
    assert [packs.map_size(name) for name in maps] == [(30, 22), (15, 11), (30, 22)]  # of the photos, as they lie
    assert tuple(packs.specs("plain")["labels"].shape) == (1, 22, 30)


def test_bands_make_no_difference_to_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    view = camera(BARREL)
    labels = Regions(torch.arange(44 * 60, dtype=torch.int32).reshape(1, 44, 60), torch.ones(44 * 60, 1))
    whole = as_pinhole_sees(labels, view)
    monkeypatch.setattr(lens, "BAND_PIXELS", 7 * view.width)
    lens._label_places.cache_clear()
    parts = as_pinhole_sees(labels, view)
    assert isinstance(whole, Regions) and isinstance(parts, Regions)
    assert torch.equal(parts.labels, whole.labels)


def test_places_of_labels_are_kept_for_the_largest_pinhole_behind_a_lens() -> None:
    view, plain = camera(BARREL), Camera.pinhole("p", 500, 400, 48.0, 47.0, 29.0, 23.0, np.eye(4))
    assert lens.kept_bytes([plain]) == 0
    assert lens.kept_bytes([plain, view]) == 2 * 4 * view.width * view.height
