"""Extremes of cameras and images."""

from __future__ import annotations

import math

import numpy as np

from liftcore.scene.cameras import MAX_FOCAL, MAX_SIDE, MIN_FOCAL, Camera
from liftcore.scene.splats import Kernel
from tests.benchmarks.stability.case import FLOORED, GAUSSIAN, Extreme
from tests.benchmarks.stability.walks import View, exact_weights, walked
from tests.scenes import ROW, camera_at_origin, splats_at


def _rolled(kernel: Kernel, angle: float) -> View:
    """A camera that is turned about its axis."""
    pose = np.eye(4)
    c, s = math.cos(angle), math.sin(angle)
    pose[:2, :2] = [[c, -s], [s, c]]
    return View(splats_at(ROW, -1.0, kernel=kernel), Camera.pinhole("v0", 15, 15, 16.0, 16.0, 7.5, 7.5, pose))


def _image_rolled(kernel: Kernel) -> np.ndarray:
    """A of the camera that is not turned, its image turned by a right angle."""
    image = exact_weights(_rolled(kernel, 0.0)).reshape(15, 15, -1)
    return np.rot90(image, -1).reshape(225, -1)


def _turned_back(kernel: Kernel) -> View:
    """A camera beyond the splats that looks back, upside down."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 5.0
    return View(splats_at(ROW, -1.0, kernel=kernel), Camera.pinhole("v0", 16, 12, 16.0, 16.0, 8.5, 6.5, pose))


def _last_alone(kernel: Kernel) -> np.ndarray:
    """The alphas of the last splat of the row, which the camera beyond meets first; nothing of the others."""
    view = _turned_back(kernel)
    A = np.full((view.camera.height * view.camera.width, len(ROW)), np.nan)
    A[:, -1] = exact_weights(View(splats_at(ROW[-1:], -1.0, kernel=kernel), view.camera))[:, 0]
    return A


def _one_ray(kernel: Kernel) -> View:
    """Faint dust on the middle of a pixel: its neighbours' alphas are below the floor."""
    return View(splats_at([(0.0, 0.0, 2.0)], -12.0, logits=-5.0, kernel=kernel), camera_at_origin())


def _narrow(width: int, height: int) -> Camera:
    return Camera.pinhole("v0", width, height, 3_000.0, 3_000.0, width / 2, height / 2, np.eye(4))


VIEWS: tuple[Extreme, ...] = (
    *(
        walked(
            f"an image of {width} x {height}",
            "weights at the centres of its pixels",
            lambda kernel, size=(width, height): View(splats_at(ROW, -1.0, kernel=kernel), camera_at_origin(*size)),
            lambda A: A.max() > 0.1,
        )
        for width, height in ((1, 1), (1, 40), (17, 33))
    ),
    walked(
        f"an image of {MAX_SIDE} x 3, the widest allowed",
        "weights at the centres of its pixels",
        lambda kernel: View(
            splats_at([(0.3 * k - 0.6, 0.0, 2.0) for k in range(5)], kernel=kernel), _narrow(MAX_SIDE, 3)
        ),
        lambda A: A.max() > 0.1,
    ),
    walked(
        f"a focal length of {MAX_FOCAL:g} px",
        "the image is one point of the splat on the axis",
        lambda kernel: View(splats_at([(0.0, 0.0, 2.0)], kernel=kernel), camera_at_origin(focal=MAX_FOCAL)),
        lambda A: np.ptp(A[:, 0]) < 1e-5 and A.min() > 0.7,
    ),
    walked(
        f"a focal length of {MIN_FOCAL:g} px",
        "the whole scene falls into one pixel",
        lambda kernel: View(splats_at(ROW, -1.0, kernel=kernel), camera_at_origin(focal=MIN_FOCAL)),
        lambda A: A[6 * 16 + 8].sum() > 0.9,
    ),
    walked(
        "a principal point 1e6 px outside the image",
        "rays far aside: they meet what lies there",
        lambda kernel: View(
            splats_at([*ROW, (-2e6 / 16 + 1.0, 0.0, 2.0)], 0.5, kernel=kernel),
            Camera.pinhole("v0", 16, 12, 16.0, 16.0, 1e6, 6.5, np.eye(4)),
        ),
        lambda A: A[:, 5].max() > 0.1,
        told="principal point far off the centre",
    ),
    walked(
        "a camera rolled by a right angle",
        "the image, rolled",
        lambda kernel: _rolled(kernel, math.pi / 2),
        like=_image_rolled,
    ),
    walked(
        "a camera rolled by 1e-9 of a radian",
        "the image within 1e-8 px",
        lambda kernel: _rolled(kernel, 1e-9),
        like=lambda kernel: exact_weights(_rolled(kernel, 0.0)),
    ),
    walked(
        "a camera upside down, looking back",
        "the order is turned round: the last of the row is met first",
        _turned_back,
        like=_last_alone,
    ),
    walked(
        "a view that sees nothing: all behind, or far aside",
        "no weight",
        lambda kernel: View(splats_at([(0.0, 0.0, -2.0), (1e6, 0.0, 1.0)], kernel=kernel), camera_at_origin()),
        lambda A: A.max() == 0,
    ),
    walked(
        "a splat on one ray only",
        "that ray's weight",
        _one_ray,
        lambda A: (A > 0).sum() == 1,
        kernels=FLOORED,
    ),
    walked(
        "splats beside the camera plane, at depth 0.0101",
        "projected to 1e6 px by the clamped Jacobian",
        lambda kernel: View(
            splats_at(
                [(s * x, 0.3 * x, 0.0101) for x in (0.01, 1.0, 100.0) for s in (-1, 1)], [-1, -3, 0], kernel=kernel
            ),
            camera_at_origin(),
        ),
        kernels=(*GAUSSIAN, Kernel.BETA),
    ),
)
