"""Splats to screen footprints: EWA projection of 3D Gaussians (paper's delta_pr for 3DGS).

Every footprint is an ellipse written row by row, which needs no subtraction of large numbers::

    e(x, y) = kx (x - mx - slope dy)^2 + ky dy^2,   dy = y - my,   alpha = opacity 2^-e

``kx = log2(e) cov_yy / (2 det)``, ``ky = log2(e) / (2 cov_yy)``, ``slope = cov_xy / cov_yy``. The determinant is a
sum of squares (Cauchy-Binet over the three axes), so needles a thousand pixels long keep all their digits.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.jit import kernel
from liftcore.raster.constants import ALPHA_FLOOR, FIELD_MARGIN, LOW_PASS, MAX_LOG_SCALE, NEAR_PLANE

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

# Columns of a footprint record (float64).
MX, MY, SLOPE, KX, KY, REACH, EXTENT_X, EXTENT_Y, LEAN, OPACITY, PLAIN = range(11)
RECORD = 11


class View(NamedTuple):
    """A camera as the compiled code takes it."""

    pose: np.ndarray  # [3, 4] f64, world to camera
    intrinsics: np.ndarray  # [4] f64, fx fy cx cy, pixels
    limits: np.ndarray  # [4] f64, x/z and y/z bounds for the Jacobian: -x +x -y +y
    width: int
    height: int
    low_pass: float  # px^2, of the view's own pixels: coarser pixels have a smaller one


def view_of(camera: Camera) -> View:
    """The camera with its Jacobian limits: 1.3 times the half field, measured from each side's edge."""
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    limits = np.array(
        [
            camera.cx / camera.fx + margin_x,
            (camera.width - camera.cx) / camera.fx + margin_x,
            camera.cy / camera.fy + margin_y,
            (camera.height - camera.cy) / camera.fy + margin_y,
        ]
    )
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose = np.ascontiguousarray(camera.world_to_camera[:3])
    return View(pose, intrinsics, limits, camera.width, camera.height, LOW_PASS)


def opacities(splats: Splats, gain: float) -> np.ndarray:
    """[P] f64, ``sigmoid(gain theta)``, without overflow at any logit."""
    theta = gain * splats.opacity_logits.numpy().astype(np.float64)
    small = np.exp(-np.abs(theta))
    return np.where(theta >= 0, 1.0, small) / (1.0 + small)


def axes_of(splats: Splats) -> np.ndarray:
    """[P, 3, 3] f64, ``R diag(exp(log_scales))``: column k is the splat's axis k, world frame."""
    quats = splats.quats.numpy().astype(np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), np.array([1.0, 0.0, 0.0, 0.0]))
    w, x, y, z = unit.T
    rotation = np.empty((splats.count, 3, 3))
    rotation[:, 0, 0] = 1 - 2 * (y * y + z * z)
    rotation[:, 0, 1] = 2 * (x * y - w * z)
    rotation[:, 0, 2] = 2 * (x * z + w * y)
    rotation[:, 1, 0] = 2 * (x * y + w * z)
    rotation[:, 1, 1] = 1 - 2 * (x * x + z * z)
    rotation[:, 1, 2] = 2 * (y * z - w * x)
    rotation[:, 2, 0] = 2 * (x * z - w * y)
    rotation[:, 2, 1] = 2 * (y * z + w * x)
    rotation[:, 2, 2] = 1 - 2 * (x * x + y * y)
    log_scales = splats.log_scales.numpy().astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    return rotation * np.exp(log_scales)[:, None, :]


@kernel
def project_gaussians(first, last, means, axes, opacity, plain, view, records, depths, ids):
    """Footprints of splats ``first..last`` that touch the image, packed from row ``first`` on.

    Args:
        means: [P, 3] f32, world. axes: [P, 3, 3] f64. opacity, plain: [P] f64, with and without the gain.
        records: [P, RECORD] f64, depths: [P] f32, ids: [P] i32, all written.

    Returns:
        The number of rows written.
    """
    pose, intrinsics, limits = view.pose, view.intrinsics, view.limits
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half_log2e = 0.5 / math.log(2.0)
    low_pass = view.low_pass
    row = first
    for j in range(first, last):
        strongest = max(opacity[j], plain[j])
        if strongest < ALPHA_FLOOR:
            continue
        x = pose[0, 0] * means[j, 0] + pose[0, 1] * means[j, 1] + pose[0, 2] * means[j, 2] + pose[0, 3]
        y = pose[1, 0] * means[j, 0] + pose[1, 1] * means[j, 1] + pose[1, 2] * means[j, 2] + pose[1, 3]
        z = pose[2, 0] * means[j, 0] + pose[2, 1] * means[j, 1] + pose[2, 2] * means[j, 2] + pose[2, 3]
        if not z >= NEAR_PLANE:
            continue
        slope_x = fx * min(limits[1], max(-limits[0], x / z)) / z
        slope_y = fy * min(limits[3], max(-limits[2], y / z)) / z
        # L = J W R S, the projected axes: cov = L L^T + low-pass.
        xx = low_pass
        yy = low_pass
        xy = 0.0
        minors = 0.0
        previous_u = previous_v = first_u = first_v = 0.0
        for k in range(3):
            ax = pose[0, 0] * axes[j, 0, k] + pose[0, 1] * axes[j, 1, k] + pose[0, 2] * axes[j, 2, k]
            ay = pose[1, 0] * axes[j, 0, k] + pose[1, 1] * axes[j, 1, k] + pose[1, 2] * axes[j, 2, k]
            az = pose[2, 0] * axes[j, 0, k] + pose[2, 1] * axes[j, 1, k] + pose[2, 2] * axes[j, 2, k]
            u = fx / z * ax - slope_x * az
            v = fy / z * ay - slope_y * az
            xx += u * u
            yy += v * v
            xy += u * v
            if k == 0:
                first_u, first_v = u, v
            else:
                minors += (previous_u * v - previous_v * u) ** 2
            if k == 2:
                minors += (first_u * v - first_v * u) ** 2
            previous_u, previous_v = u, v
        det = minors + low_pass * (xx + yy - low_pass)
        reach = math.log2(strongest / ALPHA_FLOOR)
        spread = math.sqrt(reach / half_log2e)
        extent_x = spread * math.sqrt(xx)
        extent_y = spread * math.sqrt(yy)
        mx = fx * x / z + cx
        my = fy * y / z + cy
        # The nearest pixel centres lie half a pixel inside the image.
        if not (mx + extent_x >= 0.5 and mx - extent_x <= view.width - 0.5):
            continue
        if not (my + extent_y >= 0.5 and my - extent_y <= view.height - 0.5):
            continue
        records[row, MX] = mx
        records[row, MY] = my
        records[row, SLOPE] = xy / yy
        records[row, KX] = half_log2e * yy / det
        records[row, KY] = half_log2e / yy
        records[row, REACH] = reach
        records[row, EXTENT_X] = extent_x
        records[row, EXTENT_Y] = extent_y
        records[row, LEAN] = xy / xx * extent_x
        records[row, OPACITY] = opacity[j]
        records[row, PLAIN] = plain[j]
        depths[row] = z
        ids[row] = j
        row += 1
    return row - first
