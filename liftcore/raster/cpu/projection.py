"""A scene and a camera as the compiled projections take them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import FIELD_MARGIN, LOW_PASS, MAX_LOG_SCALE

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

HALF_LOG2_E = 0.5 / math.log(2.0)  # 2^-(HALF_LOG2_E q) = exp(-q / 2)


class Scene(NamedTuple):
    """The splats, activated, as the compiled code takes them: numbers of one kind lie side by side, for vectors."""

    means: np.ndarray  # [3, P] f32, world
    axes: np.ndarray  # [3, 3, P] f64 ([3, 2, P] for 2DGS), scaled axes in columns, world
    opacity: np.ndarray  # [P] f64, with the gain
    fade: np.ndarray  # [P] f64, -log2 of it
    plain: np.ndarray  # [P] f64, without the gain
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
    pose = np.ascontiguousarray(camera.viewmat[:3])
    return View(pose, intrinsics, limits, camera.width, camera.height, LOW_PASS)


def opacities(splats: Splats, gain: float) -> np.ndarray:
    """[P] f64, ``sigmoid(gain theta)``, without overflow at any logit."""
    theta = gain * splats.opacity_logits.numpy().astype(np.float64)
    small = np.exp(-np.abs(theta))
    return np.where(theta >= 0, 1.0, small) / (1.0 + small)


def axes_of(splats: Splats) -> np.ndarray:
    """[3, 3, P] f64, ``R diag(exp(log_scales))``: column k is the splat's axis k, world frame; two axes for 2DGS."""
    quats = splats.quats.numpy().astype(np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), np.array([1.0, 0.0, 0.0, 0.0]))
    w, x, y, z = unit.T
    rotation = np.empty((3, 3, splats.count))
    rotation[0, 0] = 1 - 2 * (y * y + z * z)
    rotation[0, 1] = 2 * (x * y - w * z)
    rotation[0, 2] = 2 * (x * z + w * y)
    rotation[1, 0] = 2 * (x * y + w * z)
    rotation[1, 1] = 1 - 2 * (x * x + z * z)
    rotation[1, 2] = 2 * (y * z - w * x)
    rotation[2, 0] = 2 * (x * z - w * y)
    rotation[2, 1] = 2 * (y * z + w * x)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    log_scales = splats.log_scales.numpy().astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    return np.ascontiguousarray(rotation[:, : log_scales.shape[1]] * np.exp(log_scales.T))


@inlined
def to_camera(pose, vectors, j):
    """Point j of [3, P] in the camera's frame."""
    px, py, pz = vectors[0, j], vectors[1, j], vectors[2, j]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    return x, y, z


@inlined
def turned(pose, axes, j, k):
    """Axis k of splat j in the camera's frame."""
    px, py, pz = axes[0, k, j], axes[1, k, j], axes[2, k, j]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
    return x, y, z


@inlined
def fade_of(opacity):
    """``-log2 o``: what the exponent of a falloff grows by, so that it is the alpha's."""
    return -math.log2(opacity) if opacity > 0 else math.inf


@kernel
def fades_of(opacities):
    """[n] f64, ``-log2 o`` of each."""
    fades = np.empty(opacities.shape[0])
    for j in range(opacities.shape[0]):
        fades[j] = fade_of(opacities[j])
    return fades
