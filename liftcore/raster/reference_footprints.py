"""The footprint of every kernel in plain float64, each written as it is defined. See ``raster.reference``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.raster.constants import ALPHA_FLOOR, EDGE_ON, FIELD_MARGIN, LARGEST_EXPONENT, LOW_PASS, MAX_LOG_SCALE
from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from liftcore.raster.base import CompositingParams
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

CUT_BAND = 1e-4  # relative distance to a cut-off within which float32 may decide otherwise
_HORIZON_BAND = 1e-6  # of a disc's horizon, in the centre's depth over the crossing's
_SUPPORT_BAND = 1e-5  # of sigma = 1
_STEEPEST = 16.0  # d alpha / d log(sigma) from which the rounding of sigma to float32 shows in the fifth digit


def rotation(quat: np.ndarray) -> np.ndarray:
    """[3, 3] f64 of a quaternion w x y z of any length; zero counts as identity."""
    length = np.linalg.norm(quat)
    w, x, y, z = quat / length if length > 0 else np.array([1.0, 0.0, 0.0, 0.0])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def camera_axes(splats: Splats, j: int, camera: Camera) -> np.ndarray:
    """[3, K] f64, the scaled axes of splat j in the camera's frame: three, or two for 2DGS.

    A scale of zero is the limit of small ones: a disc that has become a line keeps its plane.
    """
    scales = np.exp(splats.log_scales[j].double().numpy().clip(min=-MAX_LOG_SCALE))
    return camera.viewmat[:3, :3] @ rotation(splats.quats[j].double().numpy())[:, : len(scales)] * scales


def camera_mean(splats: Splats, j: int, camera: Camera) -> np.ndarray:
    """[3] f64, the centre of splat j in the camera's frame."""
    return camera.viewmat[:3, :3] @ splats.means[j].double().numpy() + camera.viewmat[:3, 3]


def projected_gaussian(splats: Splats, j: int, camera: Camera) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean [2] in pixels, conic [2, 2] and opacity compensation of splat j (EWA: cov = J W Sigma W^T J^T + 0.3 I).

    The determinant is a sum of squares over pairs of axes (Cauchy-Binet), for products of long axes cancel. The
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
    own = sum(np.linalg.det(L[:, [first, second]]) ** 2 for first, second in ((0, 1), (0, 2), (1, 2)))
    det = own + LOW_PASS * (cov[0, 0] + cov[1, 1]) + LOW_PASS**2
    cov += LOW_PASS * np.eye(2)
    conic = np.array([[cov[1, 1], -cov[0, 1]], [-cov[0, 1], cov[0, 0]]]) / det
    return mean, conic, float(np.sqrt(own / det))


def alphas(
    splats: Splats, j: int, camera: Camera, walk: CompositingParams, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Alpha of splat j on rays through ``pixels`` [R, 2], before the cap, and the rays [R] hard to decide."""
    opacity = 1 / (1 + np.exp(-walk.opacity_logit_scale * float(splats.opacity_logits[j])))
    if splats.kernel is Kernel.GAUSSIAN_2D:
        g, hard = disc_exponents(splats, j, camera, pixels)
        return _above_the_floor(opacity * np.exp(-g / 2), hard)
    mean, conic, compensation = projected_gaussian(splats, j, camera)
    sigma = np.einsum("ri,ij,rj->r", pixels - mean, conic, pixels - mean)
    if splats.kernel is Kernel.BETA:
        assert splats.beta is not None
        with np.errstate(over="ignore"):
            return _beta_kernel(opacity, sigma, 4 * np.exp(float(splats.beta[j])))
    if walk.antialiased:
        opacity *= compensation
    return _above_the_floor(opacity * np.exp(-sigma / 2), np.zeros(len(sigma), bool))


def disc_exponents(splats: Splats, j: int, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``g = min(s^2 + t^2, 2 |p - mu|^2)`` [R] of disc j, and the rays [R] near its horizon.

    ``h_u = p_x w - u``, ``h_v = p_y w - v``, ``z = h_u x h_v``, ``s = z_x / z_z``, ``t = z_y / z_z``, with the rows
    u, v, w of the homography from (s, t, 1) to the image. A crossing counts where it lies before the camera, and on
    no ray when the disc is seen edge-on.
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


def _beta_kernel(opacity: float, sigma: np.ndarray, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """``o (1 - sigma)^beta`` where sigma < 1, and the rays at a steep end or a jump of it: hard to decide.

    Powers below the smallest that float32 holds count as none, in every backend.
    """
    inside = sigma < 1
    within = np.where(inside, sigma, 0.0)
    logarithm = np.log1p(-within)
    with np.errstate(invalid="ignore", over="ignore"):  # an infinite beta leaves the point sigma = 0
        exponent = np.where(within > 0, -beta * logarithm / np.log(2.0), 0.0)
        steep = opacity * beta * within * np.exp((beta - 1) * logarithm)
    raw = np.where(inside & (exponent < LARGEST_EXPONENT), opacity * np.exp2(-exponent), 0.0)
    jump = (beta < 1) & (np.abs(sigma - 1) < _SUPPORT_BAND)
    return raw, (steep > _STEEPEST) | jump | (np.abs(exponent / LARGEST_EXPONENT - 1) < _SUPPORT_BAND)
