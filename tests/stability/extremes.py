"""Lifts of extreme inputs against exact arithmetic: one table an aspect, each row a test (``test_extremes.py``).

The error of weights is the largest difference from the float64 reference over all weights, their squares, the row
sums and the total weight, on all rays of the view; rays that float32 decided otherwise at a cut-off are left out. The
error of features is the largest difference from the dense closed form in float64, over the codebook's largest value.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

import liftcore as lc
from liftcore.scene.cameras import MAX_FOCAL, MAX_SIDE, MIN_FOCAL
from liftcore.scene.splats import Kernel
from tests.scenes import ROTATION, ROW, camera_at_origin, random_grid, splats_at
from tests.stability.extreme_measures import (
    AWAY,
    BETA,
    DEFAULTS,
    DISC,
    FLOORED,
    GAUSSIAN,
    HEIGHT,
    SUM,
    WIDTH,
    Extreme,
    Outcome,
    Scene,
    View,
    at,
    lift_of,
    messages_of,
    view_of,
    weights_of,
)

CENTRE = 6 * 16 + 8  # the ray through the axis of ``camera_at_origin``
MIDDLE = [(0.0, 0.0, 2.0)]  # one splat there
OPAQUE = 1e4  # a logit
ALPHA = 1 / (1 + math.exp(-1.0))  # of the logit 1
ON_NEAR_PLANE = float(np.nextafter(np.float32(0.01), np.float32(1)))  # the first float32 that is not below 0.01
DUST = math.log(1e-12)  # a log scale
THIN, ASKEW = 1e-6, math.atan2(1.0, 2.0)  # scale and angle of a hair
ENDLESS = lc.CompositingParams(transmittance_stop=0.0)


def _pinhole(width: int, height: int, focal: float, centre: tuple[float, float], pose: np.ndarray) -> lc.Camera:
    return lc.Camera.pinhole("v0", width, height, focal, focal, *centre, pose)


def _opaque_or_absent(A: np.ndarray) -> bool:
    return A[:, [1, 4]].max() == 0 and 0.9 < A[:, 0].max() <= 0.99 + 1e-6


def _visible(A: np.ndarray) -> bool:
    return A.max() > 0.1


# fmt: off
OPACITIES: tuple[Extreme, ...] = (
    view_of("opacity logits of +-infinity, as converters of quantised splats write them",
        at(ROW, logits=[math.inf, -math.inf, 0.5, math.inf, -math.inf]), _opaque_or_absent),
    view_of("every splat transparent (logits of -20)", at(ROW, logits=-20.0), lambda A: A.max() == 0, kernels=FLOORED,
        text="never seen"),
    view_of("the same, DBS, which has no floor", at(ROW, logits=-20.0), lambda A: 1e-9 < A.max() < 3e-9, kernels=BETA,
        bound=1e-12),
    view_of("every splat opaque (logits of 1e4)", at(MIDDLE * 6, logits=OPAQUE),
        lambda A: (A > 0.5).sum(axis=1).max() == 1 and A[CENTRE, 1:].max() <= 0.0099 + 1e-6),
    view_of("a cap of 0.9999999", at(MIDDLE * 3, logits=OPAQUE, params=replace(ENDLESS, alpha_cap=0.9999999)),
        lambda A: A[CENTRE, 0] > 0.999999),
)
# fmt: on


def _about_x(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


# fmt: off
SHAPES: tuple[Extreme, ...] = (
    view_of("a log scale of minus infinity on one axis", at(ROW, [-1.0, -math.inf, -2.0]),
        like=at(ROW, [-1.0, DUST, -2.0])),
    view_of("scales of 1e-12", at(ROW, DUST), lambda A: A.max() > 1e-3, text="smaller than 1e-07 scene units"),
    view_of("scales of 1e6", at(ROW, math.log(1e6)), lambda A: A.max() > 0.7, text="larger than the scene"),
    view_of("needles and sheets: axes 1e6 apart",
        at(ROW, [[0, -13.8, -13.8], [-13.8, 0, -13.8], [-13.8, -13.8, 0], [0, 0, -13.8], [-13.8, 0, 0]],
            quats=ROTATION),
        _visible),
    view_of("discs seen edge-on, to 1e-9 of a radian",
        at([(0.0, 0.0, 2.0 + 0.1 * k) for k in range(4)], [-0.5, 0.3, -16.0], camera=camera_at_origin(24, 24),
            quats=[_about_x(math.pi / 2 + tilt) for tilt in (0.0, 1e-9, 1e-5, 1e-3)]),
        _visible, kernels=DISC),
    view_of("quaternions of zero", at(ROW, [0.0, -2.0, -3.0], quats=(0.0, 0.0, 0.0, 0.0)),
        like=at(ROW, [0.0, -2.0, -3.0]), text="zero quaternion"),
    view_of("dust under the mip filter's compensation", at(ROW, DUST, params=lc.CompositingParams(antialiased=True)),
        lambda A: A.max() == 0, kernels=GAUSSIAN, text="smaller than 1e-07 scene units"),
    view_of("700 discs behind each other, of which a ray meets few before it has stopped",
        at([(0.0, 0.0, 1.0 + 0.01 * k) for k in range(700)], 1.0, logits=[2.0] * 8 + [-2.0] * 692),
        lambda A: A[:, 12:].max() == 0 and A.sum(axis=1).max() <= 1.0, kernels=DISC),
    view_of("a hair askew, .8 of its thickness off the centres: from pixel to pixel s changes by up to a million",
        at([(-0.8 * THIN * math.sin(ASKEW), 0.8 * THIN * math.cos(ASKEW), 2.0)], [2.0, math.log(THIN), 0.0],
            camera=camera_at_origin(64, 32), quats=(math.cos(ASKEW / 2), 0.0, 0.0, math.sin(ASKEW / 2))),
        lambda A: A.reshape(32, 64)[7, 14] > 0.4, kernels=DISC),  # far from its middle
    *(
        view_of(f"a floor around the camera that ends at its horizon, turned by {tilt:g}",
            at([(0.0, height, 0.5), (0.3, height, 3.0)], 2.0, camera=camera_at_origin(40, 40), quats=_about_x(tilt)),
            lambda A: bool(A.any() and (A == 0).any(axis=0).all()), kernels=DISC)
        for height, tilt in ((-0.5, 1.4), (0.01, math.pi / 2), (0.3, 1.2))
    ),
    view_of("a floor that rises towards the camera and passes behind it: rays upwards meet it only backwards",
        at([(0.0, 0.2, 0.1)], 3.0, camera=_pinhole(21, 21, 10.0, (10.5, 10.5), np.eye(4)),
            quats=_about_x(math.pi / 2 + 1e-3)),
        lambda A: A.reshape(21, 21)[:5, 10].max() == 0 and A.reshape(21, 21)[14:, 10].min() > 0.5, kernels=DISC),
    # Weight on the ray through the middle only.
    view_of("DBS: b of +30", at(MIDDLE, -0.5, betas=30.0), lambda A: (A > 0).sum() == 1, kernels=BETA),
)
# fmt: on


def _far_away(offset: float) -> Scene:
    """A scene and its camera, both ``offset`` from the origin."""
    pose = np.eye(4)
    pose[:3, 3] = [-offset, offset, 20.0 - offset]
    means = [(offset + 4 * k - 8, -offset + 2 * k, offset + 4 * k) for k in range(5)]
    return at(means, 1.0, camera=_pinhole(16, 12, 16.0, (8.5, 6.5), pose))


def _unordered(kernel: Kernel) -> Outcome:
    """Splats a tenth apart, seen from ten million away, and written far to near."""
    count, distance = 6, 1e7
    z = 0.1 * np.arange(count)[::-1]
    splats = splats_at(np.stack([0 * z, 0 * z, z], axis=1), log_scales=-1.0, kernel=kernel)
    pose = np.eye(4)
    pose[2, 3] = distance
    camera = _pinhole(1, 1, distance, (0.5, 0.5), pose)
    got = weights_of(splats, camera, DEFAULTS)[0][0]
    exact = ALPHA * (1 - ALPHA) ** np.arange(count)[::-1]
    as_in_the_file = bool(np.allclose(got, exact[::-1], atol=1e-6))
    return Outcome(float(np.abs(got - exact).max()), messages_of(splats, camera), as_in_the_file)


def _crowd(logit: float) -> Callable[[Kernel], Outcome]:
    """A million splats behind each other on the one ray of an image, beside the geometric series."""

    def measure(kernel: Kernel) -> Outcome:
        means = np.zeros((1_000_000, 3))
        means[:, 2] = np.linspace(1.0, 1_000.0, len(means))
        camera = camera_at_origin(1, 1)
        splats = splats_at(means, log_scales=-1.0, logits=logit, kernel=kernel)
        got = weights_of(splats, camera, DEFAULTS)[0][0]
        alpha = 1 / (1 + math.exp(-float(np.float32(logit))))
        transmittance = np.exp(np.arange(len(means) + 1) * math.log1p(-alpha))
        exact = np.where(transmittance[1:] > DEFAULTS.transmittance_stop, alpha * transmittance[:-1], 0.0)
        error = max(float(np.abs(got - exact).max()), abs(float(got.sum() - exact.sum())))
        return Outcome(error, messages_of(splats, camera), bool(np.isfinite(got).all()))

    return measure


# fmt: off
PLACES: tuple[Extreme, ...] = (
    view_of("world coordinates of 1e7, the camera beside them", _far_away(1e7), like=_far_away(0.0),
        text="positions came in float32"),
    # The order is lost, as the lift tells.
    Extreme("a camera 1e7 from splats a tenth apart", _unordered, bound=0.75, text="float32 depths cannot order"),
    view_of("depth ties", at(MIDDLE * 6),
        lambda A: np.allclose(A[CENTRE], [ALPHA * (1 - ALPHA) ** k for k in range(6)], atol=1e-6)),
    view_of("splats on the near plane, a rounding before it, at the camera and behind",
        at([(0.0, 0.0, z) for z in (ON_NEAR_PLANE, math.nextafter(0.01, 0), 0.0, -0.01, -5.0)], -4.0),
        lambda A: A[:, 0].max() > 0 and A[:, 1:].max() == 0),
    Extreme("a million splats on one ray", _crowd(-5.0), kernels=FLOORED),
    Extreme("a million DBS splats of alpha 1e-6 on one ray", _crowd(math.log(1e-6)), kernels=BETA, bound=1e-4),
)
# fmt: on


# fmt: off
VIEWS: tuple[Extreme, ...] = (
    view_of("an image of 1 x 1", at(ROW, -1.0, camera=camera_at_origin(1, 1)), _visible),
    view_of(f"an image of {MAX_SIDE} x 3, the widest allowed",
        at([(0.3 * k - 0.6, 0.0, 2.0) for k in range(5)],
            camera=_pinhole(MAX_SIDE, 3, 3_000.0, (MAX_SIDE / 2, 1.5), np.eye(4))),
        _visible),
    view_of(f"a focal length of {MAX_FOCAL:g} px", at(MIDDLE, camera=camera_at_origin(focal=MAX_FOCAL)),
        lambda A: np.ptp(A[:, 0]) < 1e-5 and A.min() > 0.7),
    view_of(f"a focal length of {MIN_FOCAL:g} px", at(ROW, -1.0, camera=camera_at_origin(focal=MIN_FOCAL)),
        lambda A: A[CENTRE].sum() > 0.9),
    view_of("a principal point 1e6 px outside the image",
        at([*ROW, (-2e6 / 16 + 1.0, 0.0, 2.0)], 0.5, camera=_pinhole(16, 12, 16.0, (1e6, 6.5), np.eye(4))),
        lambda A: A[:, 5].max() > 0.1, text="principal point far off the centre"),
)
# fmt: on


TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a third of a turn about (1, 1, 1)
THIRD_OF_A_TURN = (0.5, 0.5, 0.5, 0.5)  # the same as a quaternion
FRAME_SCALES = (-1.0, -1.5, -2.0)


def _transformed(scale: float, digits: type = np.float64) -> Scene:
    """A row of splats turned, shifted and scaled, and the camera moved to where they are."""

    def scene(kernel: Kernel) -> View:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = scale * TURN, scale * np.array([3.0, -2.0, 1.0])
        camera = camera_at_origin().transformed(matrix.astype(digits).astype(np.float64))
        means = np.asarray(ROW, np.float32).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        splats = splats_at(means, FRAME_SCALES, quats=THIRD_OF_A_TURN, kernel=kernel)
        return View(replace(splats, log_scales=splats.log_scales + math.log(scale)), camera, DEFAULTS)

    return scene


# fmt: off
FRAMES: tuple[Extreme, ...] = (
    view_of("a frame 0.01 times as large", _transformed(0.01), like=at(ROW, FRAME_SCALES)),
    view_of("a frame 1e+06 times as large", _transformed(1e6), like=at(ROW, FRAME_SCALES), text="further than"),
    view_of("a frame given in float32", _transformed(0.37, digits=np.float32), like=at(ROW, FRAME_SCALES)),
)
# fmt: on


STEP = 1e-3  # of the longest value, for what is stored in float16
LARGEST_I16 = 32_767


def checkerboard(
    rows: int = 5, channels: int = 9, scale: float = 1.0, dtype: torch.dtype = torch.float32
) -> lc.Regions:
    """Regions of 4 x 4 pixels that read ``rows`` random vectors, whose largest value is ``scale``."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    labels = torch.tensor((y // 4 * 4 + x // 4) % rows, dtype=torch.int32)[None]
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, channels))
    return lc.Regions(labels, torch.tensor(vectors / np.abs(vectors).max() * scale).to(dtype))


def _labelled(labels: np.ndarray, rows: int) -> lc.Regions:
    """Labels [h, w] over random vectors."""
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, 4))
    return lc.Regions(torch.tensor(labels, dtype=torch.int32)[None], torch.tensor(vectors, dtype=torch.float32))


def _region_a_pixel() -> lc.Regions:
    return _labelled(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), HEIGHT * WIDTH)


def _cancelling() -> lc.Regions:
    """Two vectors, one the other's negative up to a thousandth, in turn on all pixels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    book = torch.full((2, 6), 1e4)
    book[1] *= -(1 - 1e-3)
    return lc.Regions(torch.tensor((x + y) % 2, dtype=torch.int32)[None], book)


# fmt: off
LENGTHS: tuple[Extreme, ...] = (
    lift_of("F = 1", checkerboard(channels=1)),
    lift_of("F = 8192", checkerboard(channels=8_192), kernels=GAUSSIAN),
    *(
        lift_of(
            f"values to {scale:g}, given in {str(dtype).removeprefix('torch.')}, to be stored in float16",
            checkerboard(5, 40, scale, dtype),
            lambda lift, stored=stored: lift.features.dtype == stored,
            settings={"dtype": "float16"},
            kernels=GAUSSIAN,
            bound=STEP if stored == torch.float16 else SUM,
            text="" if stored == torch.float16 else "float16 does not hold",
        )
        for scale, dtype, stored in (
            (65_504.0, torch.float32, torch.float16),
            (70_000.0, torch.float32, torch.float32),
            (1e-30, torch.float32, torch.float32),
        )
    ),
    lift_of("a codebook of zeros", lc.Regions(checkerboard(3).labels, torch.zeros(3, 7)),
        lambda lift: not lift.features.any(), bound=0.0, text="codebook rows are zero"),
    lift_of("vectors that cancel: +1e4 and -9990 in turn", _cancelling()),
)
# fmt: on

# fmt: off
MAPS: tuple[Extreme, ...] = (
    lift_of("a region a pixel", _region_a_pixel()),
    lift_of("labels of 32,766 and 32,767, the last of int16",
        _labelled(LARGEST_I16 - np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2, LARGEST_I16 + 1), kernels=GAUSSIAN,
        text="are read by no label"),
    lift_of("a view without any label", _labelled(np.full((3, 4), -1), 2),
        lambda lift: not bool(lift.has_feature.any()) and bool((lift.total_weight > 0).any()), bound=0.0,
        text="no labelled ray reached any splat"),
    lift_of("a view that sees nothing beside one that does", {AWAY: checkerboard(), "v0": checkerboard()},
        lambda lift: bool(lift.has_feature.any()), text="1 of 2 views meet no splat: away"),
    lift_of("views that all see nothing", {AWAY: checkerboard()},
        lambda lift: not bool(lift.has_feature.any()), bound=0.0,
        text="poses are world to camera"),
    lift_of("a splat that one ray alone meets", _region_a_pixel(),
        splats=splats_at([(0.125, 0.125, 0.0)], -12.0, logits=-4.0), kernels=GAUSSIAN),
    lift_of("a grid of 1 x 1 cell", lc.FeatureGrid(torch.ones(1, 1, 6)),
        lambda lift: bool((lift.features[lift.has_feature] - 1).abs().max() < 1e-6)),
    lift_of("a grid finer than the pixels", random_grid(0, (50, 70))),
    lift_of("squared weights and a gain of 16", checkerboard(), settings={"power": 2, "gain": 16.0},
        kernels=GAUSSIAN),
    lift_of("weights of 1e-20, squared (DBS)", checkerboard(), lambda lift: float(lift.total_weight[0]) < 1e-15,
        splats=splats_at([(0.0, 0.0, 0.0)], 0.0, logits=-46.0, kernel=Kernel.BETA), settings={"power": 2},
        text="where float32 loses digits", kernels=BETA),
)
# fmt: on

EXTREMES = (*OPACITIES, *SHAPES, *PLACES, *VIEWS, *FRAMES, *LENGTHS, *MAPS)
