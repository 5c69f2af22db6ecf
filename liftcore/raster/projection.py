"""Splats to screen footprints: EWA projection of 3D Gaussians and of beta kernels (paper's delta_pr).

Every footprint is an ellipse written row by row, which needs no subtraction of large numbers::

    e(x, y) = kx (x - mx - slope dy)^2 + ky dy^2,   dy = y - my

``kx = unit cov_yy / det``, ``ky = unit / cov_yy``, ``slope = cov_xy / cov_yy``. For 3DGS the unit is log2(e) / 2, so
that ``alpha = opacity 2^-e``; for DBS it is one, and e is sigma. A record has the root of kx. The determinant is a
sum of squares (Cauchy-Binet over the three axes), so needles a thousand pixels long keep all their digits.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import FIELD_MARGIN, LOW_PASS, MAX_LOG_SCALE, NEAR_PLANE
from liftcore.raster.records import (
    BETA,
    EXTENT_X,
    EXTENT_Y,
    FADE,
    KY,
    LEAN,
    MX,
    MY,
    OPACITY,
    PLAIN,
    REACH,
    ROOT_X,
    SLOPE,
)

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

HALF_LOG2_E = 0.5 / math.log(2.0)  # 2^-(HALF_LOG2_E q) = exp(-q / 2)


class Scene(NamedTuple):
    """The splats, activated, as the compiled code takes them."""

    means: np.ndarray  # [P, 3] f32, world
    axes: np.ndarray  # [P, 3, 3] f64 ([P, 3, 2] for 2DGS), scaled axes in columns, world
    opacity: np.ndarray  # [P] f64, with the gain
    plain: np.ndarray  # [P] f64, without it
    reach: np.ndarray  # [P] f64, the largest e (or sigma) with a weight; negative for none
    beta: np.ndarray  # [P] f64, DBS only ([0] otherwise): the exponent


class Targets(NamedTuple):
    """Where a projection writes, a row a splat."""

    records: np.ndarray  # [P, RECORD] f64
    depths: np.ndarray  # [P] f32
    ids: np.ndarray  # [P] i32


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
    """[P, 3, 3] f64, ``R diag(exp(log_scales))``: column k is the splat's axis k, world frame; two axes for 2DGS."""
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
    return np.ascontiguousarray(rotation[:, :, : log_scales.shape[1]] * np.exp(log_scales)[:, None, :])


@inlined
def to_camera(pose, vectors, j):
    """Row j of [P, 3] points in the camera's frame."""
    px, py, pz = vectors[j, 0], vectors[j, 1], vectors[j, 2]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    return x, y, z


@inlined
def turned(pose, axes, j, k):
    """Axis k of splat j in the camera's frame."""
    px, py, pz = axes[j, 0, k], axes[j, 1, k], axes[j, 2, k]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
    return x, y, z


@inlined
def fade_of(opacity):
    """``-log2 o``: what the exponent of a falloff grows by, so that it is the alpha's."""
    return -math.log2(opacity) if opacity > 0 else math.inf


@kernel
def project_ellipses(first, last, scene, view, unit, antialiased, targets):
    """Footprints of the splats ``first..last`` that touch the image, packed from row ``first`` on.

    Args:
        scene: Scene. view: View. unit: of e, see above. targets: Targets, written.
        antialiased: opacities times ``sqrt(det(cov) / det(cov + low-pass))`` (the mip filter's compensation).

    Returns:
        The number of rows written.
    """
    pose, intrinsics, limits = view.pose, view.intrinsics, view.limits
    means, axes, records = scene.means, scene.axes, targets.records
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    low_pass = view.low_pass
    has_beta = scene.beta.shape[0] > 0
    row = first
    for j in range(first, last):
        reach = scene.reach[j]
        if reach < 0:
            continue
        x, y, z = to_camera(pose, means, j)
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
            ax, ay, az = turned(pose, axes, j, k)
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
        faded = math.sqrt(minors / det) if antialiased else 1.0
        if faded < 1.0:
            reach += math.log2(faded) if faded > 0 else -math.inf
            if reach < 0:
                continue
        spread = math.sqrt(reach / unit)
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
        records[row, ROOT_X] = math.sqrt(unit * yy / det)
        records[row, KY] = unit / yy
        records[row, REACH] = reach
        records[row, EXTENT_X] = extent_x
        records[row, EXTENT_Y] = extent_y
        records[row, LEAN] = xy / xx * extent_x
        records[row, OPACITY] = faded * scene.opacity[j]
        records[row, FADE] = fade_of(faded * scene.opacity[j])
        records[row, PLAIN] = faded * scene.plain[j]
        if has_beta:
            records[row, BETA] = scene.beta[j]
        targets.depths[row] = z
        targets.ids[row] = j
        row += 1
    return row - first
