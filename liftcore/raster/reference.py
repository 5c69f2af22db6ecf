"""The float64 reference rasterizer to which every fast path is compared; it shares only constants with them.

Read it beside the paper: for each splat its footprint as defined; for each ray the compositing of Eq. 1, splat by
splat; and A [rays, splats] as a dense matrix. It is slow and needs R x P memory; use it on small scenes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.base import RayRows, ViewRequest, ViewWeights
from liftcore.scene.compositing import (
    ALPHA_FLOOR,
    EDGE_ON,
    FIELD_MARGIN,
    LARGEST_EXPONENT,
    LOW_PASS,
    MAX_LOG_SCALE,
    NEAR_PLANE,
    CompositingParams,
    Weighting,
    check_antialiased,
)
from liftcore.scene.kernel import Kernel
from liftcore.scene.quaternions import rotation_matrices
from liftcore.values.region_weights import RegionWeights, one_view
from liftcore.values.views import Regions, ViewFeatures

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

CUT_BAND = 1e-4  # relative distance to a cut-off within which float32 may fall on its other side
EDGE_BAND = 1e-4  # the same for selections: relative for weights, pixels for centres
_HORIZON_BAND = 1e-6  # a ray is ambiguous if centre depth / crossing depth is this near to 0: parallel to the disc
_SUPPORT_BAND = 1e-5  # of sigma = 1
_STEEPEST = 16.0  # d alpha / d log(sigma) from which the rounding of sigma to float32 shows in the fifth digit


def camera_axes(splats: Splats, j: int, camera: Camera) -> np.ndarray:
    """Return the scaled axes [3, K] f64 of splat j in the camera's frame: K = 3, or 2 for 2DGS.

    Log scales are limited from below, so a scale of zero is a tiny positive one: a disc that is a line has a normal.
    """
    scales = np.exp(splats.log_scales[j].double().numpy().clip(min=-MAX_LOG_SCALE))
    return camera.viewmat[:3, :3] @ rotation_matrices(splats.quats[j].numpy())[:, : len(scales)] * scales


def camera_mean(splats: Splats, j: int, camera: Camera) -> np.ndarray:
    """Return the centre [3] f64 of splat j in the camera's frame."""
    pose = camera.about(splats.origin).viewmat
    return pose[:3, :3] @ splats.means[j].double().numpy() + pose[:3, 3]


def camera_depths(splats: Splats, camera: Camera) -> np.ndarray:
    """Return the depths [P] f64 of the splats' centres along the camera's axis."""
    axis = camera.about(splats.origin).viewmat[2]
    return splats.means.double().numpy() @ axis[:3] + axis[3]


def projected_gaussian(splats: Splats, j: int, camera: Camera) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the mean [2] in pixels, conic [2, 2] and opacity compensation of splat j.

    EWA: cov = J R Sigma R^T J^T with R the rotation from world to camera; the conic is the inverse of cov + 0.3 I
    (LOW_PASS). det(cov) is a sum of squares over pairs of axes (Cauchy-Binet), as products of long axes cancel. The
    compensation is ``sqrt(det(cov) / det(cov + 0.3 I))``.
    """
    x, y, z = camera_mean(splats, j, camera)
    mean = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    u = np.clip(x / z, -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    v = np.clip(y / z, -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    J = np.array([[camera.fx / z, 0, -camera.fx * u / z], [0, camera.fy / z, -camera.fy * v / z]])
    L = J @ camera_axes(splats, j, camera)
    cov = L @ L.T
    det_sharp = sum(np.linalg.det(L[:, [first, second]]) ** 2 for first, second in ((0, 1), (0, 2), (1, 2)))
    det = det_sharp + LOW_PASS * (cov[0, 0] + cov[1, 1]) + LOW_PASS**2
    cov += LOW_PASS * np.eye(2)
    conic = np.array([[cov[1, 1], -cov[0, 1]], [-cov[0, 1], cov[0, 0]]]) / det
    return mean, conic, float(np.sqrt(det_sharp / det))


def alphas(
    splats: Splats, j: int, camera: Camera, params: CompositingParams, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha [R] of splat j on rays through ``pixels`` [R, 2], before the cap, and its ambiguous rays [R] bool.

    A ray is ambiguous where float32 may fall on the other side of a cut-off.
    """
    opacity = 1 / (1 + np.exp(-params.opacity_logit_scale * float(splats.opacity_logits[j])))
    if splats.kernel is Kernel.GAUSSIAN_2D:
        g, hard = disc_exponents(splats, j, camera, pixels)
        return _above_the_floor(opacity * np.exp(-g / 2), hard)
    mean, conic, compensation = projected_gaussian(splats, j, camera)
    sigma = np.einsum("ri,ij,rj->r", pixels - mean, conic, pixels - mean)
    if splats.kernel is Kernel.BETA:
        assert splats.beta is not None
        with np.errstate(over="ignore"):
            return _beta_kernel(opacity, sigma, 4 * np.exp(float(splats.beta[j])))
    if params.antialiased:
        opacity *= compensation
    return _above_the_floor(opacity * np.exp(-sigma / 2), np.zeros(len(sigma), bool))


def disc_exponents(splats: Splats, j: int, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``g`` [R] of disc j, with alpha = opacity exp(-g / 2), and the rays [R] bool near its horizon.

    ``g = min(s^2 + t^2, 2 |p - mu|^2)`` with p the pixel, mu the projected centre in pixels, and (s, t) the crossing
    in the disc's axes. The second term is the low-pass of 2DGS, which keeps small discs visible.

    ``h_u = p_x w - u``, ``h_v = p_y w - v``, ``z = h_u x h_v``, ``s = z_x / z_z``, ``t = z_y / z_z``, with the rows
    u, v, w of the homography from (s, t, 1) to the image. A crossing must lie in front of the camera; a disc seen
    edge-on has none.
    """
    axes, centre = camera_axes(splats, j, camera), camera_mean(splats, j, camera)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    u, v, w = K @ np.column_stack([axes, centre])
    mu = np.array([u[2], v[2]]) / w[2]
    nearby = 2 * ((pixels - mu) ** 2).sum(axis=1)
    normal = np.cross(axes[:, 0], axes[:, 1])
    if abs(normal @ centre) <= EDGE_ON * np.linalg.norm(normal) * np.linalg.norm(centre):
        return nearby, np.zeros(len(pixels), bool)
    z = np.cross(pixels[:, :1] * w - u, pixels[:, 1:] * w - v)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s, t = z[:, 0] / z[:, 2], z[:, 1] / z[:, 2]
        depth = s * w[0] + t * w[1] + w[2]
        crossing = np.where((z[:, 2] != 0) & (depth > 0), s**2 + t**2, np.inf)
        nearness = w[2] / depth
    hard = (np.abs(nearness) < _HORIZON_BAND * (1 + np.abs(nearness - 1))) | ~np.isfinite(nearness)
    return np.minimum(np.where(np.isnan(crossing), np.inf, crossing), nearby), hard


def _above_the_floor(raw: np.ndarray, hard: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    near = np.abs(raw / ALPHA_FLOOR - 1) < CUT_BAND
    return np.where(raw < ALPHA_FLOOR, 0.0, raw), hard | near


def _beta_kernel(opacity: float, sigma: np.ndarray, falloff: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ``o (1 - sigma)^falloff`` where sigma < 1, and the ambiguous rays: where alpha is steep or has a jump.

    Values below the smallest normal float32 are zero in every backend.
    """
    inside = sigma < 1
    within = np.where(inside, sigma, 0.0)
    logarithm = np.log1p(-within)
    with np.errstate(invalid="ignore", over="ignore"):  # with an infinite exponent only sigma = 0 has an alpha
        exponent = np.where(within > 0, -falloff * logarithm / np.log(2.0), 0.0)
        steep = opacity * falloff * within * np.exp((falloff - 1) * logarithm)
    raw = np.where(inside & (exponent < LARGEST_EXPONENT), opacity * np.exp2(-exponent), 0.0)
    jump = (falloff < 1) & (np.abs(sigma - 1) < _SUPPORT_BAND)
    return raw, (steep > _STEEPEST) | jump | (np.abs(exponent / LARGEST_EXPONENT - 1) < _SUPPORT_BAND)


@dataclass(frozen=True)
class DenseView:
    """A of one view, and the ambiguous rays, on which float32 may fall on the other side of a cut-off."""

    A: np.ndarray  # [H * W, P] f64, row i = y * W + x
    cut: np.ndarray  # [H * W] bool: some alpha or T of the ray lies within CUT_BAND of its cut-off


def dense_view(splats: Splats, camera: Camera, params: CompositingParams) -> DenseView:
    """Return A of one view (paper Eq. 1): ``w = alpha T``, front to back, with the usual cut-offs of 3DGS.

    Splats are sorted by camera depth rounded to float32, ties by row. A splat that would bring T to the stop or
    below has no weight.
    """
    check_antialiased(splats.kernel, params.antialiased)
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    rays = pixels.shape[0]
    z = camera_depths(splats, camera)
    A = np.zeros((rays, splats.count))
    cut = np.zeros(rays, bool)
    T = np.ones(rays)
    is_done = np.zeros(rays, bool)
    for j in np.argsort(z.astype(np.float32), kind="stable"):
        if z[j] < NEAR_PLANE:
            continue
        raw, hard = alphas(splats, int(j), camera, params, pixels)
        alpha = np.minimum(raw, params.alpha_cap)
        after = T * (1 - alpha)
        stops = (after <= params.transmittance_stop) & ~is_done
        cut |= ~is_done & hard
        if params.transmittance_stop > 0:
            cut |= ~is_done & (alpha > 0) & (np.abs(after / params.transmittance_stop - 1) < CUT_BAND)
        is_done |= stops
        A[:, j] = np.where(is_done, 0.0, alpha * T)
        T = np.where(is_done, T, after)
    return DenseView(A, cut)


def reading_matrix(observation: ViewFeatures, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return S [rows, M] f64 and the ray [rows] of each row: a row per ray and labelled level, per ray for grids."""
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


def selected_weights(
    A: np.ndarray, splats: Splats, camera: Camera, weighting: Weighting
) -> tuple[np.ndarray, np.ndarray]:
    """Return A' [H * W, P], the weights of A that count to their power, and the ambiguous rays [H * W] bool."""
    if not weighting.top_k:
        return A**weighting.power, np.zeros(A.shape[0], bool)
    order = np.argsort(camera_depths(splats, camera).astype(np.float32), kind="stable")
    w = A[:, order]  # near to far
    counts, cut = _largest(w, weighting.top_k)
    selected = np.zeros_like(A)
    selected[:, order] = np.where(counts & (w > 0), w**weighting.power, 0.0)
    return selected, cut


def strided_rays(camera: Camera, params: CompositingParams) -> np.ndarray:
    """Return the rays of the stride as a mask [H * W] bool."""
    y, x = np.mgrid[: camera.height, : camera.width]
    left, top = params.offset
    return (((x - left) % params.stride == 0) & ((y - top) % params.stride == 0)).ravel()


def _largest(w: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of the k largest of each row, the first of ties; and the rows whose k-th is nearly tied."""
    order = np.argsort(-w, axis=1, kind="stable")
    counts = np.zeros_like(w, bool)
    np.put_along_axis(counts, order[:, :k], values=True, axis=1)
    if w.shape[1] <= k:
        return counts, np.zeros(w.shape[0], bool)
    last, following = (np.take_along_axis(w, order[:, [at]], axis=1)[:, 0] for at in (k - 1, k))
    return counts, (following > 0) & (last - following < EDGE_BAND * last)


class ReferenceRaster:
    """The dense reference as a backend (``liftcore.raster.base.Raster``), for conformance tests."""

    def __init__(self, splats: Splats) -> None:
        self.splats = splats

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """Return ``A'^T S`` by dense products, and the total weight of unscaled weights."""
        S, ray = reading_matrix(observation, camera.width, camera.height)
        A = dense_view(self.splats, camera, params).A
        strided = strided_rays(camera, params)
        selected = selected_weights(A, self.splats, camera, weighting)[0]
        W = selected[ray[strided[ray]]].T @ S[strided[ray]]
        total_weight = (
            dense_view(self.splats, camera, replace(params, opacity_logit_scale=1.0)).A[strided].sum(axis=0)
        )
        rows, columns = np.nonzero(W)
        splats, counts = np.unique(rows, return_counts=True)
        hit_splats = np.flatnonzero(total_weight)
        return one_view(
            torch.from_numpy(splats.astype(np.int32)),
            torch.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)),
            torch.from_numpy(columns.astype(np.int32)),
            torch.from_numpy(W[rows, columns].astype(np.float32)),
            torch.from_numpy(hit_splats.astype(np.int32)),
            torch.from_numpy(total_weight[hit_splats].astype(np.float32)),
            regions=observation.codebook.shape[0],
        )

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """Yield ``region_weights`` and ``ray_rows`` of views, one at a time."""
        for request in requests:
            weights = self.region_weights(request.camera, request.observation, request.params, request.weighting)
            yield ViewWeights(weights, self.ray_rows(request.camera, request.pixels, request.params))

    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """Return ``A X`` by a dense product."""
        image = dense_view(self.splats, camera, params).A @ values.double().numpy()
        return torch.from_numpy(image.astype(np.float32)).reshape(camera.height, camera.width, -1)

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return ``A 1``."""
        return self.render(camera, torch.ones(self.splats.count, 1, dtype=torch.float32), params)[:, :, 0]

    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """Return ``argmax(A Gamma) - 1`` with a dense one-hot matrix Gamma [P, K + 1], its first column for -1."""
        onehot = np.eye(int(labels.max()) + 2)[labels.numpy() + 1]
        sums = dense_view(self.splats, camera, params).A @ onehot
        return torch.from_numpy(sums.argmax(axis=1).astype(np.int32) - 1).reshape(camera.height, camera.width)

    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Count the pixels on whose ray a splat has an alpha, before occlusion."""
        y, x = np.mgrid[: camera.height, : camera.width]
        pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        z = camera_depths(self.splats, camera)
        in_front = (int(j) for j in np.flatnonzero(z >= NEAR_PLANE))
        areas = np.zeros(self.splats.count, np.float32)
        for j in in_front:
            areas[j] = np.count_nonzero(alphas(self.splats, j, camera, params, pixels)[0])
        return torch.from_numpy(areas)

    def forget(self) -> None:
        """Do nothing: no view is cached."""

    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Return rows of the dense A. Unlike other backends, splats are in order of their rows, not near to far."""
        A = dense_view(self.splats, camera, params).A
        rows = A[(pixels[:, 1] * camera.width + pixels[:, 0]).numpy()]
        ray, splats = np.nonzero(rows)
        starts = np.concatenate([[0], np.cumsum(np.bincount(ray, minlength=rows.shape[0]))])
        weights = rows[ray, splats].astype(np.float32)
        return RayRows(
            torch.from_numpy(starts.astype(np.int64)),
            torch.from_numpy(splats.astype(np.int32)),
            torch.from_numpy(weights),
        )
