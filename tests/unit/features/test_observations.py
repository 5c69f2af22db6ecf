"""Single levels, and maps of distorted photos resampled to a pinhole."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.scene.cameras import Camera, behind_lens
from liftcore.scene.distortion import Brown, Distortion, Fisheye
from liftcore.values.lens import as_pinhole_sees
from liftcore.values.views import FeatureGrid, Regions

BARREL = Brown(k1=-0.25, k2=0.04, p1=0.002, p2=-0.001)
PINCUSHION = Brown(k1=0.2)
WIDE = Fisheye(k1=0.02)


def camera(distortion: Distortion) -> Camera:
    return behind_lens(Camera.pinhole("v", 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4)), distortion)


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
