"""Sampled rays of a view: their rows of A and of S."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from liftcore.raster.base import RayRows
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.values.views import Regions, ViewFeatures, cells_under


@dataclass(frozen=True)
class Readout:
    """Rows of S for n rays; a ray has a row for each labelled level, or one for a grid."""

    rays: np.ndarray  # [rows] i64, index of the ray
    columns: np.ndarray  # [rows, taps] i64, codebook rows
    shares: np.ndarray  # [rows, taps] f64, sum to one

    def observed(self, codebook: Tensor) -> Tensor:
        """Return B [rows, F] f32 of the rays."""
        vectors = codebook[torch.from_numpy(self.columns)].to(torch.float32)
        return (vectors * torch.from_numpy(self.shares).to(torch.float32)[:, :, None]).sum(dim=1)


@dataclass(frozen=True)
class SampledRays:
    """Some rays of one view: their rows of A and of S."""

    rows: RayRows
    readout: Readout


def sample_pixels(camera: Camera, count: int, seed: tuple[int, int], params: CompositingParams) -> Tensor:
    """Sample up to ``count`` different pixels (x, y) of the strided view, [n, 2] i32 in image order."""
    left, top = params.offset
    columns, rows = np.arange(left, camera.width, params.stride), np.arange(top, camera.height, params.stride)
    total = columns.size * rows.size
    indices = np.random.default_rng(seed).choice(total, size=min(count, total), replace=False)
    indices.sort()
    places = np.stack([columns[indices % columns.size], rows[indices // columns.size]], axis=1)
    return torch.from_numpy(places.astype(np.int32))


def read_pixels(observation: ViewFeatures, camera: Camera, pixels: Tensor) -> Readout:
    """Return the rows of S of pixels [n, 2] (x, y)."""
    x, y = pixels.numpy().astype(np.int64).T
    if isinstance(observation, Regions):
        _, rows, columns = observation.labels.shape
        label_y, label_x = cells_under(y, camera.height, rows), cells_under(x, camera.width, columns)
        labels = observation.labels.numpy()[:, label_y, label_x]
        level, ray = np.nonzero(labels >= 0)
        return Readout(ray, labels[level, ray][:, None].astype(np.int64), np.ones((ray.shape[0], 1)))
    rows, columns = observation.grid.shape[:2]
    u = ((x + 0.5) * columns / camera.width - 0.5).clip(0, columns - 1)
    v = ((y + 0.5) * rows / camera.height - 0.5).clip(0, rows - 1)
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    share_x, share_y = u - left, v - top
    cells = np.stack(
        [top * columns + left, top * columns + right, bottom * columns + left, bottom * columns + right], axis=1
    )
    shares = np.stack(
        [(1 - share_y) * (1 - share_x), (1 - share_y) * share_x, share_y * (1 - share_x), share_y * share_x], axis=1
    )
    return Readout(np.arange(x.shape[0]), cells, shares)
