"""A and B of a small scene as dense float64 matrices, with the raster's own weights: the optimum's oracle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import reading_matrix
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.values.views import ViewFeatures
from tests.scenes import random_camera, random_grid, random_regions, random_splats


def dense_view(raster: CpuRaster, camera: Camera, params: CompositingParams) -> np.ndarray:
    """A [H * W, P] f64 as the raster traces it."""
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)
    rows = raster.ray_rows(camera, pixels, params)
    A = np.zeros((len(pixels), raster.splats.count))
    A[np.repeat(np.arange(len(A)), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    return A


class SmallScene:
    """Three views of a random scene: A [rows, P] and B [rows, F] of the same rays."""

    def __init__(self, seed: int, grids: bool = False, observations: Sequence[ViewFeatures] | None = None) -> None:
        self.params, self.splats = CompositingParams(), random_splats(seed, 25)
        self.views = [random_camera(seed + k, 22 + 3 * k, 17 + 2 * k, name=f"v{k}") for k in range(3)]
        random_maps = [random_grid(seed + k) if grids else random_regions(seed + k) for k in range(3)]
        self.observations = list(observations or random_maps)
        self.raster = CpuRaster(self.splats, threads=2)
        parts = [self._rows(view, view_map) for view, view_map in zip(self.views, self.observations, strict=True)]
        self.A, self.B = (np.concatenate(part) for part in zip(*parts, strict=True))
        self.row_sums = self.A.sum(axis=0)
        self.has_weight = self.row_sums > 0
        safe = np.where(self.has_weight, self.row_sums, 1.0)
        self.closed_form = torch.tensor(self.A.T @ self.B / safe[:, None], dtype=torch.float32)
        self.codebooks = [observation.codebook for observation in self.observations]

    def _rows(self, view: Camera, observation: ViewFeatures) -> tuple[np.ndarray, np.ndarray]:
        S, ray = reading_matrix(observation, view.width, view.height)
        return dense_view(self.raster, view, self.params)[ray], S @ observation.codebook.double().numpy()

    def loss(self, X: np.ndarray | torch.Tensor) -> float:
        """``|A X - B|^2``."""
        return float(((self.A @ np.asarray(X, np.float64) - self.B) ** 2).sum())
