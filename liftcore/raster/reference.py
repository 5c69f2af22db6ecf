"""The plain float64 rasterizer that every fast path is held to.

Read it beside the paper: for each splat its footprint, for each ray the walk of Eq. 1, one splat after the other, and
A [rays, splats] written out as a dense matrix. It is slow and needs R x P memory; use it on small scenes.
Nothing is shared with the CPU backend but the constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.features.views import Regions, ViewFeatures
from liftcore.raster.antialiased import check_antialiased
from liftcore.raster.base import CompositingParams, RayRows, RegionWeights, ViewRequest, ViewWeights, Weighting
from liftcore.raster.constants import NEAR_PLANE
from liftcore.raster.cpu.side_by_side import one_by_one
from liftcore.raster.reference_footprints import CUT_BAND, alphas
from liftcore.raster.reference_weights import counted_weights, walked_rays

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats


@dataclass(frozen=True)
class DenseView:
    """A of one view, and the rays whose value hangs on a knife's edge."""

    A: np.ndarray  # [H * W, P] f64, row i = y * W + x
    cut: np.ndarray  # [H * W] bool: some alpha or T of the ray lies within CUT_BAND of its cut-off


def dense_view(splats: Splats, camera: Camera, walk: CompositingParams) -> DenseView:
    """A of one view (paper Eq. 1): ``w = alpha T``, front to back, with the field's cut-offs.

    The order is by camera depth rounded to float32, ties by row; the stop is exclusive.
    """
    check_antialiased(splats.kernel, walk.antialiased)
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    rays = pixels.shape[0]
    z = (splats.means.double().numpy() @ camera.viewmat[2, :3]) + camera.viewmat[2, 3]
    A = np.zeros((rays, splats.count))
    cut = np.zeros(rays, bool)
    T = np.ones(rays)
    done = np.zeros(rays, bool)
    for j in np.argsort(z.astype(np.float32), kind="stable"):
        if z[j] < NEAR_PLANE:
            continue
        raw, hard = alphas(splats, int(j), camera, walk, pixels)
        alpha = np.minimum(raw, walk.alpha_cap)
        after = T * (1 - alpha)
        stops = (after <= walk.transmittance_stop) & ~done
        cut |= ~done & hard
        if walk.transmittance_stop > 0:
            cut |= ~done & (alpha > 0) & (np.abs(after / walk.transmittance_stop - 1) < CUT_BAND)
        done |= stops
        A[:, j] = np.where(done, 0.0, alpha * T)
        T = np.where(done, T, after)
    return DenseView(A, cut)


def reading_matrix(observation: ViewFeatures, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """S [rows, M] f64 and the ray of every row [rows]: one row a labelled level and ray, or one a ray for grids."""
    rays = np.arange(width * height)
    x, y = rays % width, rays // width
    if isinstance(observation, Regions):
        labels = observation.labels.numpy()
        rows, columns = labels.shape[1:]
        at = labels[:, ((2 * y + 1) * rows) // (2 * height), ((2 * x + 1) * columns) // (2 * width)]
        level, ray = np.nonzero(at >= 0)
        S = np.zeros((ray.shape[0], observation.codebook.shape[0]))
        S[np.arange(ray.shape[0]), at[level, ray]] = 1.0
        return S, ray
    rows, columns = observation.grid.shape[:2]
    S = np.zeros((rays.shape[0], rows * columns))
    u = np.clip((x + 0.5) * columns / width - 0.5, 0, columns - 1)
    v = np.clip((y + 0.5) * rows / height - 0.5, 0, rows - 1)
    for right in (0, 1):
        for below in (0, 1):
            column = np.minimum(np.floor(u).astype(int) + right, columns - 1)
            row = np.minimum(np.floor(v).astype(int) + below, rows - 1)
            share = (u % 1 if right else 1 - u % 1) * (v % 1 if below else 1 - v % 1)
            np.add.at(S, (rays, row * columns + column), share)
    return S, rays


class OracleRaster:
    """The dense reference as a backend (``liftcore.raster.base.Raster``), for conformance tests."""

    def __init__(self, splats: Splats) -> None:
        self.splats = splats

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, walk: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` by dense products, and the evidence of plain weights."""
        S, ray = reading_matrix(observation, camera.width, camera.height)
        A = dense_view(self.splats, camera, walk).A
        walked = walked_rays(camera, walk)
        chosen = counted_weights(A, self.splats, camera, walk, weighting)[0]
        W = chosen[ray[walked[ray]]].T @ S[walked[ray]]
        plain = dense_view(self.splats, camera, replace(walk, opacity_logit_scale=1.0)).A[walked].sum(axis=0)
        rows, columns = np.nonzero(W)
        splats, counts = np.unique(rows, return_counts=True)
        met = np.flatnonzero(plain)
        return RegionWeights(
            torch.from_numpy(splats.astype(np.int32)),
            torch.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)),
            torch.from_numpy(columns.astype(np.int32)),
            torch.from_numpy(W[rows, columns].astype(np.float32)),
            torch.from_numpy(met.astype(np.int32)),
            torch.from_numpy(plain[met].astype(np.float32)),
        )

    def iterate_views(self, looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """``region_weights`` and ``ray_rows`` of views, one at a time."""
        return one_by_one(self, looks)

    def render(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A X`` by a dense product."""
        image = dense_view(self.splats, camera, walk).A @ values.double().numpy()
        return torch.from_numpy(image.astype(np.float32)).reshape(camera.height, camera.width, -1)

    def adjoint(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A^T Y`` by a dense product."""
        Y = values.double().numpy().reshape(camera.height * camera.width, -1)
        return torch.from_numpy((dense_view(self.splats, camera, walk).A.T @ Y).astype(np.float32))

    def row_sums(self, camera: Camera, walk: CompositingParams) -> Tensor:
        """``A 1``."""
        return self.render(camera, torch.ones(self.splats.count, 1), walk)[:, :, 0]

    def strongest_labels(self, camera: Camera, labels: Tensor, walk: CompositingParams) -> Tensor:
        """``argmax(A Gamma) - 1`` with the one-hot matrix Gamma [P, K + 1] written out, its first column for -1."""
        onehot = np.eye(int(labels.max()) + 2)[labels.numpy() + 1]
        sums = dense_view(self.splats, camera, walk).A @ onehot
        return torch.from_numpy(sums.argmax(axis=1).astype(np.int32) - 1).reshape(camera.height, camera.width)

    def forget(self) -> None:
        """Nothing: no view is kept."""

    def ray_rows(self, camera: Camera, pixels: Tensor, walk: CompositingParams) -> RayRows:
        """Rows of A, read off the dense matrix (in row order, not in depth order)."""
        A = dense_view(self.splats, camera, walk).A
        rows = A[(pixels[:, 1] * camera.width + pixels[:, 0]).numpy()]
        ray, splats = np.nonzero(rows)
        starts = np.concatenate([[0], np.cumsum(np.bincount(ray, minlength=rows.shape[0]))])
        weights = rows[ray, splats].astype(np.float32)
        return RayRows(
            torch.from_numpy(starts.astype(np.int64)),
            torch.from_numpy(splats.astype(np.int32)),
            torch.from_numpy(weights),
        )
