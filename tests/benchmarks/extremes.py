"""What becomes of a lift at the extremes, beside exact arithmetic: one table an aspect.

    python -m tests.benchmarks.extremes [--json]

Each row is a test too (``tests/stability/test_table.py``). The error of weights is the largest difference from the
float64 reference over all weights, their squares, the row sums and the evidence, on all rays of the view and over the
kernels that are named; rays that float32 decided otherwise at a cut-off are counted apart. The error of a distorted
photo is how far from a pixel, in pixels, its ray meets the photo again. The error of features is the largest
difference from the dense closed form in float64, over the largest value of the codebook. What float32 gives is shown
for the first kernel named. "Told" are the words of ``splatlift inspect`` and of the lift's own warnings.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from liftcore.features.views import FeatureGrid, Regions, ViewFeatures
from liftcore.io.colmap import MODELS_BY_NAME, calibration
from liftcore.io.transforms import Similarity
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.cameras import (
    MAX_FOCAL,
    MAX_SIDE,
    MIN_FOCAL,
    Camera,
    Cameras,
    behind_lens,
    distortion_warning,
    drawn_by,
)
from liftcore.scene.distortion import Brown, Distortion, Fisheye, photo_places
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import LiftSettings
from tests.benchmarks.base import command_line, tell
from tests.benchmarks.extreme_measures import (
    AWAY,
    FLOORED,
    GAUSSIAN,
    HEIGHT,
    KERNELS,
    SCENES,
    WEIGHTS,
    WIDTH,
    Extreme,
    Found,
    Task,
    View,
    always,
    cloud,
    exact_weights,
    lifted,
    refused,
    run,
    survey,
    told_of,
    walked,
    weights_of,
)
from tests.scenes import ROW, TURNED, camera_at_origin, splats_at

CENTRE = 6 * 16 + 8  # the ray through the axis of ``camera_at_origin``
OPAQUE = 1e4  # a logit
ALPHA = 1 / (1 + math.exp(-1.0))  # of the logit 1
ON_NEAR_PLANE = float(np.nextafter(np.float32(0.01), np.float32(1)))  # the first float32 that is not below 0.01


def _row(kernel: Kernel, walk: CompositingParams | None = None, **more: Any) -> View:
    """Five splats in a row before the camera; ``more`` as ``splats_at`` takes it."""
    return View(splats_at(ROW, **more, kernel=kernel), camera_at_origin(), walk or CompositingParams())


def in_a_row(
    name: str,
    claim: Callable[[np.ndarray], bool] = always,
    *,
    walk: CompositingParams | None = None,
    kernels: tuple[Kernel, ...] = KERNELS,
    like: Callable[[Kernel], np.ndarray] | None = None,
    bound: float = WEIGHTS,
    told: str = "",
    **splats: Any,
) -> Extreme:
    """``walked`` of five splats in a row."""
    more: dict[str, Any] = {"kernels": kernels, "bound": bound, "told": told}
    return walked(name, lambda kernel: _row(kernel, walk, **splats), claim, like, **more)


def _stack(kernel: Kernel, count: int, logits: ArrayLike, walk: CompositingParams | None = None) -> View:
    """So many splats at one place before the camera."""
    splats = splats_at(np.tile([0.0, 0.0, 2.0], (count, 1)), logits=logits, kernel=kernel)
    return View(splats, camera_at_origin(), walk or CompositingParams())


def _far_away(kernel: Kernel, offset: float) -> View:
    """A scene and its camera, both ``offset`` from the origin."""
    pose = np.eye(4)
    pose[:3, 3] = [-offset, offset, 20.0 - offset]
    means = [(offset + 4 * k - 8, -offset + 2 * k, offset + 4 * k) for k in range(5)]
    return View(
        splats_at(means, log_scales=1.0, kernel=kernel), Camera.pinhole("v0", 16, 12, 16.0, 16.0, 8.5, 6.5, pose)
    )


def _opaque_or_absent(A: np.ndarray) -> bool:
    return A[:, [1, 4]].max() == 0 and 0.9 < A[:, 0].max() <= 0.99 + 1e-6


def _in_file_order(A: np.ndarray) -> bool:
    expected = [ALPHA * (1 - ALPHA) ** k for k in range(6)]
    return np.allclose(A[CENTRE, :6], expected, atol=1e-6)


def _unordered(kernel: Kernel) -> Found:
    """Splats a tenth apart, seen from ten million away, and written far to near."""
    count, distance = 6, 1e7
    z = 0.1 * np.arange(count)[::-1]
    splats = splats_at(np.stack([0 * z, 0 * z, z], axis=1), log_scales=-1.0, kernel=kernel)
    pose = np.eye(4)
    pose[2, 3] = distance
    camera = Camera.pinhole("v0", 1, 1, distance, distance, 0.5, 0.5, pose)
    got = weights_of(splats, camera, CompositingParams())[0][0]
    exact = ALPHA * (1 - ALPHA) ** np.arange(count)[::-1]
    error = float(np.abs(got - exact).max())
    as_in_the_file = bool(np.allclose(got, exact[::-1], atol=1e-6))
    return Found(
        "not so: all at one depth, so the order of the file, the farthest first",
        error,
        told_of(splats, camera),
        as_in_the_file,
    )


def _crowd(count: int, logit: float, stop: float, kernel: Kernel) -> Found:
    """So many splats behind each other on the one ray of an image, beside the geometric series."""
    means = np.zeros((count, 3))
    means[:, 2] = np.linspace(1.0, 1_000.0, count)
    camera = camera_at_origin(1, 1)
    splats = splats_at(means, log_scales=-1.0, logits=logit, kernel=kernel)
    got = weights_of(splats, camera, CompositingParams(transmittance_stop=stop))[0][0]
    alpha = 1 / (1 + math.exp(-float(np.float32(logit))))
    light = np.exp(np.arange(count + 1) * math.log1p(-alpha))
    exact = np.where(light[1:] > stop, alpha * light[:-1], 0.0)
    error = max(float(np.abs(got - exact).max()), abs(float(got.sum() - exact.sum())))
    kept = f"{int((got > 0).sum())} of {count} met, row sum {got.sum():.7f} for {exact.sum():.7f}"
    return Found(kept, error, told_of(splats, camera), bool(np.isfinite(got).all()))


OPACITIES: tuple[Extreme, ...] = (
    in_a_row("opacity logits of +-1e4", _opaque_or_absent, logits=[OPAQUE, -OPAQUE, 0.5, OPAQUE, -OPAQUE]),
    in_a_row(
        "opacity logits of +-infinity, as converters of quantised splats write them",
        _opaque_or_absent,
        logits=[math.inf, -math.inf, 0.5, math.inf, -math.inf],
    ),
    in_a_row(
        "every splat transparent (logits of -20)",
        lambda A: A.max() == 0,
        logits=-20.0,
        kernels=FLOORED,
        told="never seen",
    ),
    in_a_row(
        "the same, DBS, which has no floor",
        lambda A: 1e-9 < A.max() < 3e-9,
        logits=-20.0,
        kernels=(Kernel.BETA,),
        bound=1e-12,
    ),
    walked(
        "every splat opaque (logits of 1e4)",
        lambda kernel: _stack(kernel, 6, OPAQUE),
        lambda A: (A > 0.5).sum(axis=1).max() == 1 and A[CENTRE, 1:].max() <= 0.0099 + 1e-6,
    ),
    walked(
        "forty opaque splats without a stop",
        lambda kernel: _stack(kernel, 40, OPAQUE, CompositingParams(transmittance_stop=0.0)),
        lambda A: A.sum(axis=1).max() <= 1 + 1e-6,
    ),
    in_a_row(
        "the gain lambda at 0.01",
        lambda A: 0.3 < A[:, 1].max() < 0.6,
        logits=[5.0, -5.0, 1.0, 0.0, -1.0],
        walk=CompositingParams(opacity_logit_scale=0.01),
    ),
    in_a_row(
        "the gain lambda at 16",
        lambda A: A[:, [1, 4]].max() == 0,
        logits=[5.0, -5.0, 1.0, 0.0, -1.0],
        walk=CompositingParams(opacity_logit_scale=16.0),
        kernels=FLOORED,
    ),
    walked(
        "a cap of 0.9999999",
        lambda kernel: _stack(kernel, 3, OPAQUE, CompositingParams(alpha_cap=0.9999999, transmittance_stop=0.0)),
        lambda A: A[CENTRE, 0] > 0.999999,
    ),
)

SHAPES: tuple[Extreme, ...] = (
    in_a_row(
        "a log scale of minus infinity on one axis",
        log_scales=[-1.0, -math.inf, -2.0],
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[-1.0, math.log(1e-12), -2.0])),
    ),
    in_a_row(
        "scales of 1e-12", lambda A: A.max() > 1e-3, log_scales=math.log(1e-12), told="smaller than 1e-07 scene units"
    ),
    in_a_row("scales of 1e6", lambda A: A.max() > 0.7, log_scales=math.log(1e6), told="larger than the scene"),
    in_a_row(
        "needles and sheets: axes 1e6 apart",
        lambda A: A.max() > 0.1,
        log_scales=[[0, -13.8, -13.8], [-13.8, 0, -13.8], [-13.8, -13.8, 0], [0, 0, -13.8], [-13.8, 0, 0]],
        quats=TURNED,
    ),
    walked(
        "discs seen edge-on, to 1e-9 of a radian",
        lambda kernel: View(
            splats_at(
                [(0.0, 0.0, 2.0 + 0.1 * k) for k in range(4)],
                [-0.5, 0.3, -16.0],
                quats=[_about_x(math.pi / 2 + tilt) for tilt in (0.0, 1e-9, 1e-5, 1e-3)],
                kernel=kernel,
            ),
            camera_at_origin(24, 24),
        ),
        lambda A: A.max() > 0.1,
        kernels=(Kernel.GAUSSIAN_2D,),
    ),
    in_a_row(
        "quaternions of zero",
        log_scales=[0.0, -2.0, -3.0],
        quats=(0.0, 0.0, 0.0, 0.0),
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[0.0, -2.0, -3.0])),
        told="zero quaternion",
    ),
    in_a_row(
        "quaternions of length 1e-18 and 1e18",
        log_scales=[0.0, -2.0, -3.0],
        quats=[np.multiply(TURNED, 10.0**k) for k in (-18, 18, 0, 9, -9)],
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[0.0, -2.0, -3.0], quats=TURNED)),
    ),
    in_a_row(
        "dust under the mip filter's compensation",
        lambda A: A.max() == 0,
        log_scales=math.log(1e-12),
        walk=CompositingParams(antialiased=True),
        kernels=GAUSSIAN,
        told="smaller than 1e-07 scene units",
    ),
    *(
        walked(
            f"DBS: b of {b:+g}",
            lambda kernel, b=b: View(splats_at([(0.0, 0.0, 2.0)], -0.5, betas=b, kernel=kernel), camera_at_origin()),
            claim,
            kernels=(Kernel.BETA,),
        )
        for b, shape, claim in (
            (-30.0, "a cylinder", lambda A: np.isclose(A[A > 0].max(), ALPHA, atol=1e-5)),
            (30.0, "weight on the ray through the middle only", lambda A: (A > 0).sum() == 1),
        )
    ),
)

PLACES: tuple[Extreme, ...] = (
    walked(
        "world coordinates of 1e7, the camera beside them",
        lambda kernel: _far_away(kernel, 1e7),
        like=lambda kernel: exact_weights(_far_away(kernel, 0.0)),
        told="where float32 is coarse",
    ),
    Extreme(
        "a camera 1e7 from splats a tenth apart",
        _unordered,
        bound=0.75,  # the order is lost, as the lift tells
        told="float32 depths cannot order",
    ),
    walked("depth ties", lambda kernel: _stack(kernel, 6, 1.0), _in_file_order),
    walked(
        "splats on the near plane, a rounding before it, at the camera and behind",
        lambda kernel: View(
            splats_at(
                [(0.0, 0.0, z) for z in (ON_NEAR_PLANE, math.nextafter(0.01, 0), 0.0, -0.01, -5.0)],
                -4.0,
                kernel=kernel,
            ),
            camera_at_origin(),
        ),
        lambda A: A[:, 0].max() > 0 and A[:, 1:].max() == 0,
    ),
    walked(
        "a camera inside splats",
        lambda kernel: View(
            splats_at([(0.0, 0.0, 0.05), (0.02, 0.01, 0.3), (0.0, 0.0, 3.0)], [0.5, 0.0, -0.5], kernel=kernel),
            camera_at_origin(),
        ),
        lambda A: A.max() > 0.1,
    ),
    walked(
        "two hundred identical splats",
        lambda kernel: _stack(kernel, 200, -3.0),
        lambda A: bool((np.diff(A[CENTRE, :150]) < 0).all()),
    ),
    walked(
        "one splat (P = 1)",
        lambda kernel: View(splats_at([(0.0, 0.0, 2.0)], kernel=kernel), camera_at_origin()),
        lambda A: abs(A.max() - ALPHA) < 1e-5,
    ),
    Extreme("a million splats on one ray", lambda kernel: _crowd(1_000_000, -5.0, 1e-4, kernel), kernels=FLOORED),
    Extreme(
        "a million DBS splats of alpha 1e-6 on one ray",
        lambda kernel: _crowd(1_000_000, math.log(1e-6), 1e-4, kernel),
        kernels=(Kernel.BETA,),
        bound=1e-4,
    ),
)


def _about_x(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


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
            lambda kernel, size=(width, height): View(splats_at(ROW, -1.0, kernel=kernel), camera_at_origin(*size)),
            lambda A: A.max() > 0.1,
        )
        for width, height in ((1, 1), (1, 40), (17, 33))
    ),
    walked(
        f"an image of {MAX_SIDE} x 3, the widest allowed",
        lambda kernel: View(
            splats_at([(0.3 * k - 0.6, 0.0, 2.0) for k in range(5)], kernel=kernel), _narrow(MAX_SIDE, 3)
        ),
        lambda A: A.max() > 0.1,
    ),
    walked(
        f"a focal length of {MAX_FOCAL:g} px",
        lambda kernel: View(splats_at([(0.0, 0.0, 2.0)], kernel=kernel), camera_at_origin(focal=MAX_FOCAL)),
        lambda A: np.ptp(A[:, 0]) < 1e-5 and A.min() > 0.7,
    ),
    walked(
        f"a focal length of {MIN_FOCAL:g} px",
        lambda kernel: View(splats_at(ROW, -1.0, kernel=kernel), camera_at_origin(focal=MIN_FOCAL)),
        lambda A: A[6 * 16 + 8].sum() > 0.9,
    ),
    walked(
        "a principal point 1e6 px outside the image",
        lambda kernel: View(
            splats_at([*ROW, (-2e6 / 16 + 1.0, 0.0, 2.0)], 0.5, kernel=kernel),
            Camera.pinhole("v0", 16, 12, 16.0, 16.0, 1e6, 6.5, np.eye(4)),
        ),
        lambda A: A[:, 5].max() > 0.1,
        told="principal point far off the centre",
    ),
    walked("a camera rolled by a right angle", lambda kernel: _rolled(kernel, math.pi / 2), like=_image_rolled),
    walked(
        "a camera rolled by 1e-9 of a radian",
        lambda kernel: _rolled(kernel, 1e-9),
        like=lambda kernel: exact_weights(_rolled(kernel, 0.0)),
    ),
    walked("a camera upside down, looking back", _turned_back, like=_last_alone),
    walked(
        "a view that sees nothing: all behind, or far aside",
        lambda kernel: View(splats_at([(0.0, 0.0, -2.0), (1e6, 0.0, 1.0)], kernel=kernel), camera_at_origin()),
        lambda A: A.max() == 0,
    ),
    walked("a splat on one ray only", _one_ray, lambda A: (A > 0).sum() == 1, kernels=FLOORED),
    walked(
        "splats beside the camera plane, at depth 0.0101",
        lambda kernel: View(
            splats_at(
                [(s * x, 0.3 * x, 0.0101) for x in (0.01, 1.0, 100.0) for s in (-1, 1)], [-1, -3, 0], kernel=kernel
            ),
            camera_at_origin(),
        ),
        kernels=(*GAUSSIAN, Kernel.BETA),
    ),
)


PHOTO_WIDTH, PHOTO_HEIGHT, FOCAL = 64, 48, 50.0  # of the photo
CORNER = math.hypot(PHOTO_WIDTH, PHOTO_HEIGHT) / 2 / FOCAL  # on the plane one unit before the camera
PIXELS = 1e-4  # of a place that float32 keeps
TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a third of a turn about (1, 1, 1)
THIRD_OF_A_TURN = (0.5, 0.5, 0.5, 0.5)  # the same as a quaternion
TOLD = "features must be of the photos as they were taken"


def _behind(distortion: Distortion, focal: float = FOCAL) -> Camera:
    return behind_lens(
        Camera.pinhole("v0", PHOTO_WIDTH, PHOTO_HEIGHT, focal, focal, PHOTO_WIDTH / 2, PHOTO_HEIGHT / 2, np.eye(4)),
        distortion,
    )


def photographed(name: str, camera: Callable[[], Camera], claim: Callable[[Camera], bool] = always) -> Extreme:
    """An extreme whose error is how far, in pixels, a pixel lies from where its ray meets the photo again.

    Args:
        name: of the row. camera: of the distorted photo. claim: what exact arithmetic says of that camera.
    """
    return Extreme(name, partial(_round_trip, camera, claim), kernels=GAUSSIAN, bound=PIXELS, told=TOLD)


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
    splats = _lens_row(kernel)
    means = splats.means.double() @ torch.from_numpy(matrix[:3, :3].T) + torch.from_numpy(matrix[:3, 3])
    return View(
        replace(
            splats,
            means=means.float(),
            quats=torch.tensor([THIRD_OF_A_TURN]).repeat(splats.count, 1),
            log_scales=splats.log_scales + math.log(scale),
        ),
        camera,
    )


def _lens_row(kernel: Kernel) -> Splats:
    return splats_at(ROW, (-1.0, -1.5, -2.0), kernel=kernel)


def _where_they_were(kernel: Kernel) -> np.ndarray:
    """A of the row before it was moved."""
    return exact_weights(View(_lens_row(kernel), camera_at_origin()))


LENSES: tuple[Extreme, ...] = (
    photographed(
        "a distortion of 1e-12",
        lambda: _behind(Brown(k1=1e-12)),
        lambda camera: (camera.width, camera.height) == (PHOTO_WIDTH, PHOTO_HEIGHT),
    ),
    photographed(
        "a barrel lens that turns back a millionth beyond the photo's corner",
        lambda: _behind(Brown(k1=-4 / 27 / (CORNER * (1 + 1e-6)) ** 2)),
    ),
    photographed(
        "a barrel lens that turns back before the photo's corners",
        lambda: _behind(Brown(k1=-4 / 27 / (CORNER * 0.9) ** 2)),
        lambda camera: camera.lens is not None and 0.8 < camera.lens.share < 1,
    ),
    photographed("a pincushion of k1 = 1000", lambda: _behind(Brown(k1=1000.0))),
    photographed(
        "a lens of 1e9 px",
        lambda: _behind(Brown(k1=-0.3), 1e9),
        lambda camera: (camera.width, camera.height) == (PHOTO_WIDTH, PHOTO_HEIGHT),
    ),
    photographed(
        "a fisheye whose corners lie 110 degrees off its axis",
        lambda: _behind(Fisheye(), CORNER * FOCAL / math.radians(110)),
        lambda camera: camera.width / 2 / camera.fx <= math.tan(math.radians(60)) + 1 / camera.fx,
    ),
    *(
        walked(
            f"a frame {scale:g} times as large",
            partial(_moved, scale),
            like=_where_they_were,
            told="further than" if scale * 2 > 1e5 else "",
        )
        for scale in (0.01, 1e6)
    ),
    walked("a frame told in float32", partial(_moved, 0.37, digits=np.float32), like=_where_they_were),
    refused(
        "a barrel that turns back near the axis (k1 = -9)",
        lambda: _behind(Brown(k1=-9.0)),
        "of the photo",
        kernels=GAUSSIAN,
    ),
    refused(
        "a thin prism",
        lambda: calibration(MODELS_BY_NAME["THIN_PRISM_FISHEYE"], [0.0] * 12, "camera 1"),
        "undistort the photos first",
        kernels=GAUSSIAN,
    ),
    refused(
        "a frame that mirrors",
        lambda: Similarity.of(np.diag([1.0, 1.0, -1.0, 1.0]), "transform"),
        "a proper rotation",
        kernels=GAUSSIAN,
    ),
)


FLOAT16 = {"dtype": "float16"}
STEP = 1e-3  # of the longest value, for what is stored in float16
SUM = 2e-6  # of the longest value, for what is stored in float32
LARGEST_I16 = 32_767


def checkerboard(rows: int = 5, channels: int = 9, scale: float = 1.0, dtype: torch.dtype = torch.float32) -> Regions:
    """Regions of 4 x 4 pixels that read ``rows`` random vectors, whose largest value is ``scale``."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    labels = torch.tensor((y // 4 * 4 + x // 4) % rows, dtype=torch.int32)[None]
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, channels))
    return Regions(labels, torch.tensor(vectors / np.abs(vectors).max() * scale).to(dtype))


def _zero_row() -> Regions:
    observation = checkerboard(3)
    observation.codebook[1] = 0
    return observation


def _labelled(labels: np.ndarray, rows: int, channels: int = 4) -> Regions:
    """Labels [h, w] over random vectors."""
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, channels))
    return Regions(torch.tensor(labels, dtype=torch.int32)[None], torch.tensor(vectors, dtype=torch.float32))


def _one_pixel(label: int = 1, rows: int = 4) -> Regions:
    labels = np.full((HEIGHT, WIDTH), -1)
    labels[6, 8] = label
    return _labelled(labels, rows)


def _cancelling() -> Regions:
    """Two vectors, one the other's negative up to a thousandth, in turn on all pixels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    book = torch.full((2, 6), 1e4)
    book[1] *= -(1 - 1e-3)
    return Regions(torch.tensor((x + y) % 2, dtype=torch.int32)[None], book)


def _task(observation: ViewFeatures, **settings: object) -> Task:
    return Task({"v0": observation}, settings={"dtype": "float32", **settings})


LENGTHS: tuple[Extreme, ...] = (
    *(
        lifted(f"F = {channels}", _task(checkerboard(channels=channels)), bound=SUM, kernels=kernels)
        for channels, kernels in ((1, KERNELS), (2, KERNELS), (31, KERNELS), (33, KERNELS), (8_192, GAUSSIAN))
    ),
    *(
        lifted(
            f"values to {scale:g}, given in {str(given).removeprefix('torch.')}, to be stored in float16",
            Task({"v0": checkerboard(5, 40, scale, given)}, settings=FLOAT16),
            lambda made, stored=stored: made.features.dtype == stored,
            bound=STEP if stored == torch.float16 else SUM,
            told="float16 does not hold" if stored == torch.float32 else "",
            kernels=GAUSSIAN,
        )
        for scale, given, stored in (
            (65_504.0, torch.float16, torch.float16),
            (65_504.0, torch.float32, torch.float16),
            (70_000.0, torch.float32, torch.float32),
            (1e14, torch.float32, torch.float32),
            (1e-4, torch.float16, torch.float32),
            (1e-30, torch.float32, torch.float32),
        )
    ),
    lifted(
        "values of 1e-40, below the normal numbers of float32",
        _task(checkerboard(scale=1e-40)),
        bound=1e-3,
        kernels=GAUSSIAN,
    ),
    lifted("a zero row in the codebook", _task(_zero_row()), bound=SUM, told="codebook rows are zero"),
    lifted(
        "a codebook of zeros",
        _task(Regions(checkerboard(3).labels, torch.zeros(3, 7))),
        lambda made: float(made.agreement.max()) == 0,
        bound=0.0,
        told="codebook rows are zero",
    ),
    lifted(
        "vectors that cancel: +1e4 and -9990 in turn",
        _task(_cancelling()),
        lambda made: float(made.agreement.min()) < 0.2,
        bound=SUM,
    ),
)

MAPS: tuple[Extreme, ...] = (
    lifted("a mask of one pixel", _task(_one_pixel()), bound=SUM),
    lifted(
        "one label on the whole image",
        _task(_labelled(np.zeros((HEIGHT, WIDTH)), 1)),
        lambda made: bool((made.features[made.seen] - made.features[made.seen][0]).abs().max() < 1e-6),
        bound=SUM,
    ),
    lifted(
        "labels of 1 x 1 pixel",
        _task(_labelled(np.zeros((1, 1)), 1)),
        lambda made: float(made.agreement[made.seen].min()) > 1 - 1e-6,
        bound=SUM,
    ),
    lifted(
        "a region a pixel",
        _task(_labelled(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), HEIGHT * WIDTH)),
        bound=SUM,
    ),
    lifted(
        "labels of 32,766 and 32,767, the last of int16",
        _task(_labelled(LARGEST_I16 - np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2, LARGEST_I16 + 1)),
        bound=SUM,
        kernels=GAUSSIAN,
        told="are read by no label",
    ),
    lifted(
        "a label of 32,768, the first beyond int16",
        _task(_one_pixel(LARGEST_I16 + 1, LARGEST_I16 + 2)),
        bound=SUM,
        kernels=GAUSSIAN,
        told="are read by no label",
    ),
    lifted(
        "a view without any label",
        _task(_labelled(np.full((3, 4), -1), 2)),
        lambda made: not bool(made.seen.any()) and bool((made.evidence > 0).any()),
        bound=0.0,
        told="no labelled ray reached any splat",
    ),
    lifted(
        "a view that sees nothing beside one that does",
        Task({AWAY: checkerboard(), "v0": checkerboard()}),
        lambda made: bool(made.seen.any()),
        bound=SUM,
        told="1 of 2 views meet no splat: away",
    ),
    lifted(
        "views that all see nothing",
        Task({AWAY: checkerboard()}),
        lambda made: not bool(made.seen.any()),
        bound=0.0,
        told="poses are world to camera",
    ),
    lifted(
        "a splat that one ray alone meets",
        Task(
            {"v0": _labelled(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), HEIGHT * WIDTH)},
            splats_at([(0.125, 0.125, 0.0)], -12.0, logits=-4.0),
        ),
        lambda made: abs(float(made.agreement[0]) - 1) < 1e-6,
        bound=SUM,
        kernels=GAUSSIAN,
    ),
    lifted(
        "a grid of 1 x 1 cell",
        _task(FeatureGrid(torch.ones(1, 1, 6))),
        lambda made: bool((made.features[made.seen] - 1).abs().max() < 1e-6),
        bound=SUM,
    ),
    lifted(
        "labels larger than the image",
        _task(_labelled(np.arange(100 * 130).reshape(100, 130) % 4, 4)),
        bound=SUM,
    ),
    lifted("a grid of one row", _task(FeatureGrid(torch.rand(1, 9, 6, generator=torch.manual_seed(0)))), bound=SUM),
    lifted(
        "a grid finer than the pixels",
        _task(FeatureGrid(torch.rand(50, 70, 6, generator=torch.manual_seed(0)))),
        bound=SUM,
    ),
    *(
        lifted(f"squared weights and a gain of {gain:g}", _task(checkerboard(), power=2, lift_gain=gain), bound=SUM)
        for gain in (0.01, 8.0, 16.0)
    ),
    lifted(
        "weights of 1e-20, squared (DBS)",
        Task(
            {"v0": checkerboard()},
            splats_at([(0.0, 0.0, 0.0)], 0.0, logits=-46.0, kernel=Kernel.BETA),
            {"dtype": "float32", "power": 2},
        ),
        lambda made: float(made.evidence[0]) < 1e-15,
        told="where float32 loses digits",
        kernels=(Kernel.BETA,),
        bound=SUM,
    ),
)

REFUSALS: tuple[Extreme, ...] = (
    *(
        refused(
            name,
            lambda more=more: splats_at(**{"means": [(0.0, 0.0, 2.0)], **more}),
            "finite values",
            kernels=GAUSSIAN,
        )
        for name, more in (
            ("an opacity logit of nan", {"logits": math.nan}),
            ("a log scale of inf", {"log_scales": math.inf}),
            ("a place of inf", {"means": [(0.0, math.inf, 2.0)]}),
        )
    ),
    refused("no splats (P = 0)", lambda: splats_at(np.zeros((0, 3))), "empty scene", kernels=GAUSSIAN),
    refused("no views", lambda: Cameras(()), "at least one view", kernels=GAUSSIAN),
    refused(
        "values of 1e30",
        lambda: run(_task(checkerboard(scale=1e30)), cloud()),
        "finite values within",
        kernels=GAUSSIAN,
    ),
    refused(
        "a label beyond the codebook",
        lambda: run(_task(_labelled(np.full((2, 2), 4), 4)), cloud()),
        "rows of its codebook",
        kernels=GAUSSIAN,
    ),
    refused("a gain of nought", lambda: LiftSettings.of(lift_gain=0), "greater than 0", kernels=GAUSSIAN),
)


TABLES: dict[str, tuple[Extreme, ...]] = {
    "Opacities": OPACITIES,
    "Shapes": SHAPES,
    "Places and crowds": PLACES,
    "Cameras and images": VIEWS,
    "Distorted photos and other frames": LENSES,
    "Features": LENGTHS,
    "Maps, labels and gains": MAPS,
    "Refused": REFUSALS,
}
EXTREMES = tuple(extreme for table in TABLES.values() for extreme in table)


def rows_of(extremes: Iterable[Extreme]) -> Iterator[dict[str, Any]]:
    """The rows of some extremes, measured with each of their kernels."""
    for extreme in extremes:
        found = [extreme.measure(kernel) for kernel in extreme.kernels]
        errors = [part.error for part in found if part.error is not None]
        flips, rays = sum(part.flips for part in found), sum(part.rays for part in found)
        yield {
            "extreme": extreme.name,
            "kernels": "all" if extreme.kernels == KERNELS else ", ".join(extreme.kernels),
            "float32 gives": found[0].gives,
            "error": max(errors) if errors else None,
            "rays that flip": f"{flips} of {rays}" if flips else None,
            "told": "; ".join(dict.fromkeys(told for part in found for told in part.told)) or None,
        }


def main() -> None:
    """Print every table."""
    options = command_line("tests.benchmarks.extremes", __doc__).parse_args()
    for kernel in Kernel:
        warm_up(kernel)
    tables = {title: rows_of(table) for title, table in TABLES.items()} | {
        f"Wide random scenes, {SCENES} a kernel": ({"kernel": kernel} | vars(survey(kernel)) for kernel in KERNELS)
    }
    for title, rows in tables.items():
        print("" if options.json else f"\n## {title}\n")
        tell(rows, as_json=options.json, note=title)


if __name__ == "__main__":
    main()
