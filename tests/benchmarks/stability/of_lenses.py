"""Extremes of distorted photos, and of frames that trainers moved their cameras to."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.io.colmap import MODELS_BY_NAME, calibration
from liftcore.io.transforms import Similarity
from liftcore.scene.cameras import Camera, Cameras, behind_lens, distortion_warning, drawn_by
from liftcore.scene.distortion import Brown, Distortion, Fisheye, photo_places
from tests.benchmarks.stability.case import GAUSSIAN, Extreme, Found, always
from tests.benchmarks.stability.lifts import refused
from tests.benchmarks.stability.walks import View, exact_weights, walked
from tests.scenes import ROW, camera_at_origin, splats_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.scene.splats import Kernel, Splats

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0  # of the photo
CORNER = math.hypot(WIDTH, HEIGHT) / 2 / FOCAL  # on the plane one unit before the camera
PIXELS = 1e-4  # of a place that float32 keeps
TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a third of a turn about (1, 1, 1)
TURNED = (0.5, 0.5, 0.5, 0.5)  # the same as a quaternion
TOLD = "features must be of the photos as they were taken"


def _behind(distortion: Distortion, focal: float = FOCAL) -> Camera:
    return behind_lens(
        Camera.pinhole("v0", WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, np.eye(4)), distortion
    )


def photographed(
    name: str, exact: str, camera: Callable[[], Camera], claim: Callable[[Camera], bool] = always
) -> Extreme:
    """An extreme whose error is how far, in pixels, a pixel lies from where its ray meets the photo again.

    Args:
        name: of the row. exact: what exact arithmetic says.
        camera: of the distorted photo.
        claim: ``exact`` as a function of that camera.
    """
    return Extreme(name, exact, partial(_round_trip, camera, claim), kernels=GAUSSIAN, bound=PIXELS, told=TOLD)


def _round_trip(camera_of: Callable[[], Camera], claim: Callable[[Camera], bool], _: Kernel) -> Found:
    """Pixels go to the pinhole that draws, in float32 as pictures do, and back; only those that it sees count."""
    camera = camera_of()
    lens, pinhole = camera.lens, drawn_by(camera)
    if lens is None:
        raise ValueError("the camera has no lens")
    x, y = (axis.astype(np.float64) for axis in photo_places(lens))
    seen = (x >= 0) & (x <= pinhole.width) & (y >= 0) & (y <= pinhole.height)
    v, u = np.meshgrid(np.arange(lens.height) + 0.5, np.arange(lens.width) + 0.5, indexing="ij")
    back = lens.on_photo((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy)
    error = float(np.hypot(back[0] - u, back[1] - v)[seen].max())
    gives = (
        f"{camera.width}x{camera.height} lifted, {pinhole.width}x{pinhole.height} drawn, {seen.mean():.0%} of it seen"
    )
    return Found(gives, error, tuple(distortion_warning([camera])), claim(camera))


def _moved(scale: float, kernel: Kernel, digits: type = np.float64) -> View:
    """The row of splats turned, shifted and scaled, and the camera moved to where they are."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * TURN, scale * np.array([3.0, -2.0, 1.0])
    similarity = Similarity.of(matrix.astype(digits).astype(np.float64), "here")
    [camera] = similarity.moved(Cameras((camera_at_origin(),))).values()
    splats = _row(kernel)
    means = splats.means.double() @ torch.from_numpy(matrix[:3, :3].T) + torch.from_numpy(matrix[:3, 3])
    return View(
        replace(
            splats,
            means=means.float(),
            quats=torch.tensor([TURNED]).repeat(splats.count, 1),
            log_scales=splats.log_scales + math.log(scale),
        ),
        camera,
    )


def _row(kernel: Kernel) -> Splats:
    return splats_at(ROW, (-1.0, -1.5, -2.0), kernel=kernel)


def _where_they_were(kernel: Kernel) -> np.ndarray:
    """A of the row before it was moved."""
    return exact_weights(View(_row(kernel), camera_at_origin()))


LENSES: tuple[Extreme, ...] = (
    photographed(
        "a distortion of 1e-12",
        "the pinhole's image within 1e-10 px",
        lambda: _behind(Brown(k1=1e-12)),
        lambda camera: (camera.width, camera.height) == (WIDTH, HEIGHT),
    ),
    photographed(
        "a barrel lens that turns back a millionth beyond the photo's corner",
        "one ray a pixel, and rays ever farther apart",
        lambda: _behind(Brown(k1=-4 / 27 / (CORNER * (1 + 1e-6)) ** 2)),
    ),
    photographed(
        "a barrel lens that turns back before the photo's corners",
        "corners without rays; lifted is what has some",
        lambda: _behind(Brown(k1=-4 / 27 / (CORNER * 0.9) ** 2)),
        lambda camera: camera.lens is not None and 0.8 < camera.lens.share < 1,
    ),
    photographed(
        "a pincushion of k1 = 1000", "a photo of what lies near the axis", lambda: _behind(Brown(k1=1000.0))
    ),
    photographed(
        "a lens of 1e9 px",
        "rays on the axis, where there is no distortion",
        lambda: _behind(Brown(k1=-0.3), 1e9),
        lambda camera: (camera.width, camera.height) == (WIDTH, HEIGHT),
    ),
    photographed(
        "a fisheye whose corners lie 110 degrees off its axis",
        "no pinhole sees them; lifted is what lies within 60",
        lambda: _behind(Fisheye(), CORNER * FOCAL / math.radians(110)),
        lambda camera: camera.width / 2 / camera.fx <= math.tan(math.radians(60)) + 1 / camera.fx,
    ),
    *(
        walked(
            f"a frame {scale:g} times as large",
            "the weights of the scene before it was moved",
            partial(_moved, scale),
            like=_where_they_were,
            told="further than" if scale * 2 > 1e5 else "",
        )
        for scale in (0.01, 1e6)
    ),
    walked(
        "a frame told in float32",
        "the nearest rotation: the weights within its digits",
        partial(_moved, 0.37, digits=np.float32),
        like=_where_they_were,
    ),
    refused(
        "a barrel that turns back near the axis (k1 = -9)",
        "hardly a pixel with a ray of its own",
        lambda: _behind(Brown(k1=-9.0)),
        "of the photo",
        kernels=GAUSSIAN,
    ),
    refused(
        "a thin prism",
        "a distortion, which is not to be ignored",
        lambda: calibration(MODELS_BY_NAME["THIN_PRISM_FISHEYE"], [0.0] * 12, "camera 1"),
        "undistort the photos first",
        kernels=GAUSSIAN,
    ),
    refused(
        "a frame that mirrors",
        "no rotation leads there",
        lambda: Similarity.of(np.diag([1.0, 1.0, -1.0, 1.0]), "transform"),
        "a proper rotation",
        kernels=GAUSSIAN,
    ),
)
