"""``A X = B`` over all rays of all views as one linear operator, a view at a time and a block of channels at a time.

A ray has a row of B for each labelled level (one for a grid), so its row of A counts as often: with N the number of
rows of each ray, the least-squares matrix is ``sum_v A_v^T N_v A_v``, and neither A nor B is ever stored.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.features.views import NO_LABEL, Regions, ViewFeatures
from liftcore.jit import kernel
from liftcore.progress import Progress, silent
from liftcore.raster.base import Weighting
from liftcore.solve.readout import Readout, read_pixels

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from liftcore.raster.base import CompositingParams, Raster
    from liftcore.scene.cameras import Camera

_FEW = 255  # levels whose count fits a byte


class AllRays:
    """The operator. Weights are plain (power 1), whatever power the closed form takes: the aim is ``|A X - B|^2``.

    Args:
        raster: A of a view. count: P.
        views: the cameras, in the order of the sums.
        observed: view number -> what it observes, as the lift read it.
        walk: of the lift; every ray counts, whatever its stride.
    """

    def __init__(
        self,
        raster: Raster,
        count: int,
        views: Sequence[Camera],
        observed: Callable[[int], ViewFeatures],
        walk: CompositingParams,
        progress: Progress = silent,
    ) -> None:
        self.count = count
        self.views = views
        self._raster, self._observed = raster, observed
        self._walk = replace(walk, stride=1, offset=(0, 0))
        self._counts: list[np.ndarray] = []  # [H, W] of every view: rows of B of each ray
        self.row_sums = np.zeros(count)  # D = sum_v A_v^T N_v 1, [P] f64
        self.diagonal = np.zeros(count)  # of sum_v A_v^T N_v A_v, [P] f64
        self.rows = 0  # of B
        for number, camera in enumerate(views):
            self._look(number, camera)
            progress("rays", number + 1, len(views), "views")

    def _look(self, number: int, camera: Camera) -> None:
        """Count the rows of a view, and add up what they say of each splat."""
        observation = self._observed(number)
        rays = _readout(observation, camera).rays
        counts = np.bincount(rays, minlength=camera.width * camera.height).reshape(camera.height, camera.width)
        self._counts.append(counts.astype(np.uint8 if counts.max(initial=0) <= _FEW else np.int32))
        self.rows += rays.size
        labelled = _labelled(observation)
        for power, sums in ((1, self.row_sums), (2, self.diagonal)):
            weights = self._raster.region_weights(camera, labelled, self._walk, Weighting(power))
            sums[weights.splats.numpy()] += weights.weights.numpy()

    def normal(self, X: np.ndarray) -> np.ndarray:
        """``sum_v A_v^T N_v A_v X``: [P, C] f32 -> [P, C] f32."""
        total = np.zeros_like(X)
        values = torch.from_numpy(X)
        for camera, counts in zip(self.views, self._counts, strict=True):
            image = self._raster.render(camera, values, self._walk).numpy()
            image *= counts[:, :, None]
            total += self._raster.adjoint(camera, torch.from_numpy(image), self._walk).numpy()
        return total

    def gradient(self, X: np.ndarray, project: Callable[[Tensor], np.ndarray]) -> tuple[np.ndarray, float]:
        """``A^T (B - A X)`` [P, C] f32 over all rows, and ``|A X - B|^2``.

        Args:
            X: [P, C] f32. project: rows of a codebook [M, F] -> [M, C] f32, the channels that X has.
        """
        total, squares = np.zeros_like(X), 0.0
        for number, camera in enumerate(self.views):
            observation = self._observed(number)
            readout = _readout(observation, camera)
            rendered = self._raster.render(camera, torch.from_numpy(X), self._walk).numpy()
            rest = np.zeros_like(rendered)
            squares += subtract_rows(
                readout.rays,
                readout.columns,
                readout.shares,
                project(observation.codebook),
                rendered.reshape(-1, X.shape[1]),
                rest.reshape(-1, X.shape[1]),
            )
            total += self._raster.adjoint(camera, torch.from_numpy(rest), self._walk).numpy()
        return total, squares


@kernel
def subtract_rows(rays, columns, shares, codebook, rendered, rest):
    """Add ``B_i - (A X)_i`` of every row i to its ray in ``rest`` [rays, C] f32; gives the sum of their squares.

    Args:
        rays: [rows] i64. columns: [rows, taps] i64. shares: [rows, taps] f64. codebook: [M, C] f32.
        rendered: [rays, C] f32.
    """
    squares = 0.0
    for row in range(rays.shape[0]):
        ray = rays[row]
        for channel in range(codebook.shape[1]):
            value = 0.0
            for tap in range(columns.shape[1]):
                value += shares[row, tap] * codebook[columns[row, tap], channel]
            value -= rendered[ray, channel]
            rest[ray, channel] += value
            squares += value * value
    return squares


def _readout(observation: ViewFeatures, camera: Camera) -> Readout:
    """S of all pixels of a view."""
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.int32)
    return read_pixels(observation, camera, torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1)))


def _labelled(observation: ViewFeatures) -> Regions:
    """The observation with one region for all that is labelled: its region weights are sums over the rows of B."""
    if isinstance(observation, Regions):
        return Regions(observation.labels.clamp(NO_LABEL, 0), torch.ones(1, 1))
    return Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1))
