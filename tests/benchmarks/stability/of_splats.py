"""Extremes of splats: opacities, shapes, places, crowds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.raster.base import CompositingParams
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Kernel
from tests.benchmarks.stability.case import FLOORED, GAUSSIAN, Extreme, Found
from tests.benchmarks.stability.walks import View, exact_weights, told_of, walked
from tests.benchmarks.stability.weights import weights_of
from tests.scenes import ROW, TURNED, camera_at_origin, splats_at

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

CENTRE = 6 * 16 + 8  # the ray through the axis of ``camera_at_origin``
OPAQUE = 1e4  # a logit
ALPHA = 1 / (1 + math.exp(-1.0))  # of the logit 1
ON_NEAR_PLANE = float(np.nextafter(np.float32(0.01), np.float32(1)))  # the first float32 that is not below 0.01


def _row(kernel: Kernel, walk: CompositingParams | None = None, **more: Any) -> View:
    """Five splats in a row before the camera; ``more`` as ``splats_at`` takes it."""
    return View(splats_at(ROW, **more, kernel=kernel), camera_at_origin(), walk or CompositingParams())


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
    walked(
        "opacity logits of +-1e4",
        "opaque to the cap of 0.99, or absent",
        lambda kernel: _row(kernel, logits=[OPAQUE, -OPAQUE, 0.5, OPAQUE, -OPAQUE]),
        _opaque_or_absent,
    ),
    walked(
        "opacity logits of +-infinity, as converters of quantised splats write them",
        "opaque to the cap of 0.99, or absent",
        lambda kernel: _row(kernel, logits=[math.inf, -math.inf, 0.5, math.inf, -math.inf]),
        _opaque_or_absent,
    ),
    walked(
        "every splat transparent (logits of -20)",
        "alphas of 2e-9: below the floor of 1/255, so no weight",
        lambda kernel: _row(kernel, logits=-20.0),
        lambda A: A.max() == 0,
        kernels=FLOORED,
        told="never seen",
    ),
    walked(
        "the same, DBS, which has no floor",
        "weights of 2e-9",
        lambda kernel: _row(kernel, logits=-20.0),
        lambda A: 1e-9 < A.max() < 3e-9,
        kernels=(Kernel.BETA,),
        bound=1e-12,
    ),
    walked(
        "every splat opaque (logits of 1e4)",
        "a ray ends at its first splat: (1 - 0.99)^2 is the stop itself",
        lambda kernel: _stack(kernel, 6, OPAQUE),
        lambda A: (A > 0.5).sum(axis=1).max() == 1 and A[CENTRE, 1:].max() <= 0.0099 + 1e-6,
    ),
    walked(
        "forty opaque splats without a stop",
        "weights down to 1e-78, below what float32 holds",
        lambda kernel: _stack(kernel, 40, OPAQUE, CompositingParams(transmittance_stop=0.0)),
        lambda A: A.sum(axis=1).max() <= 1 + 1e-6,
    ),
    walked(
        "the gain lambda at 0.01",
        "every opacity near a half",
        lambda kernel: _row(
            kernel, logits=[5.0, -5.0, 1.0, 0.0, -1.0], walk=CompositingParams(opacity_logit_scale=0.01)
        ),
        lambda A: 0.3 < A[:, 1].max() < 0.6,
    ),
    walked(
        "the gain lambda at 16",
        "every opacity near nought or one",
        lambda kernel: _row(
            kernel, logits=[5.0, -5.0, 1.0, 0.0, -1.0], walk=CompositingParams(opacity_logit_scale=16.0)
        ),
        lambda A: A[:, [1, 4]].max() == 0,
        kernels=FLOORED,
    ),
    walked(
        "a cap of 0.9999999",
        "a tenth of a millionth of the light passes each opaque splat",
        lambda kernel: _stack(kernel, 3, OPAQUE, CompositingParams(alpha_cap=0.9999999, transmittance_stop=0.0)),
        lambda A: A[CENTRE, 0] > 0.999999,
    ),
)

SHAPES: tuple[Extreme, ...] = (
    walked(
        "a log scale of minus infinity on one axis",
        "as flat as with a scale of 1e-12",
        lambda kernel: _row(kernel, log_scales=[-1.0, -math.inf, -2.0]),
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[-1.0, math.log(1e-12), -2.0])),
    ),
    walked(
        "scales of 1e-12",
        "points: footprints of the low-pass alone",
        lambda kernel: _row(kernel, log_scales=math.log(1e-12)),
        lambda A: A.max() > 1e-3,
        told="smaller than 1e-07 scene units",
    ),
    walked(
        "scales of 1e6",
        "every ray meets every splat at its middle",
        lambda kernel: _row(kernel, log_scales=math.log(1e6)),
        lambda A: A.max() > 0.7,
        told="larger than the scene",
    ),
    walked(
        "needles and sheets: axes 1e6 apart",
        "as narrow as the low-pass, as long as they are",
        lambda kernel: _row(
            kernel,
            log_scales=[[0, -13.8, -13.8], [-13.8, 0, -13.8], [-13.8, -13.8, 0], [0, 0, -13.8], [-13.8, 0, 0]],
            quats=TURNED,
        ),
        lambda A: A.max() > 0.1,
    ),
    walked(
        "discs seen edge-on, to 1e-9 of a radian",
        "a line as wide as the low-pass",
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
    walked(
        "quaternions of zero",
        "no rotation is defined; taken as none",
        lambda kernel: _row(kernel, log_scales=[0.0, -2.0, -3.0], quats=(0.0, 0.0, 0.0, 0.0)),
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[0.0, -2.0, -3.0])),
        told="zero quaternion",
    ),
    walked(
        "quaternions of length 1e-18 and 1e18",
        "their direction alone counts",
        lambda kernel: _row(
            kernel, log_scales=[0.0, -2.0, -3.0], quats=[np.multiply(TURNED, 10.0**k) for k in (-18, 18, 0, 9, -9)]
        ),
        like=lambda kernel: exact_weights(_row(kernel, log_scales=[0.0, -2.0, -3.0], quats=TURNED)),
    ),
    walked(
        "dust under the mip filter's compensation",
        "opacity fades with the area: 1e-12 squared is none",
        lambda kernel: _row(kernel, log_scales=math.log(1e-12), walk=CompositingParams(antialiased=True)),
        lambda A: A.max() == 0,
        kernels=GAUSSIAN,
        told="smaller than 1e-07 scene units",
    ),
    *(
        walked(
            f"DBS: b of {b:+g}",
            f"beta = 4 exp(b) = {4 * math.exp(b):.2g}: {shape}",
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
        "as at the origin, from the float32 centres that the file gives",
        lambda kernel: _far_away(kernel, 1e7),
        like=lambda kernel: exact_weights(_far_away(kernel, 0.0)),
        told="where float32 is coarse",
    ),
    Extreme(
        "a camera 1e7 from splats a tenth apart",
        "the nearest first",
        _unordered,
        bound=0.75,  # the order is lost, as the lift tells
        told="float32 depths cannot order",
    ),
    walked(
        "depth ties",
        "no order is defined; that of the file is taken",
        lambda kernel: _stack(kernel, 6, 1.0),
        _in_file_order,
    ),
    walked(
        "splats on the near plane, a rounding before it, at the camera and behind",
        "the first is drawn, the others are not",
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
        "splats larger than their distance, projected by the clamped Jacobian",
        lambda kernel: View(
            splats_at([(0.0, 0.0, 0.05), (0.02, 0.01, 0.3), (0.0, 0.0, 3.0)], [0.5, 0.0, -0.5], kernel=kernel),
            camera_at_origin(),
        ),
        lambda A: A.max() > 0.1,
    ),
    walked(
        "two hundred identical splats",
        "weights fall geometrically, in the order of the file",
        lambda kernel: _stack(kernel, 200, -3.0),
        lambda A: bool((np.diff(A[CENTRE, :150]) < 0).all()),
    ),
    walked(
        "one splat (P = 1)",
        "its alpha on every ray",
        lambda kernel: View(splats_at([(0.0, 0.0, 2.0)], kernel=kernel), camera_at_origin()),
        lambda A: abs(A.max() - ALPHA) < 1e-5,
    ),
    Extreme(
        "a million splats on one ray",
        "a geometric series until the transmittance falls to 1e-4",
        lambda kernel: _crowd(1_000_000, -5.0, 1e-4, kernel),
        kernels=FLOORED,
    ),
    Extreme(
        "a million DBS splats of alpha 1e-6 on one ray",
        "two thirds of the light: 1 - 1/e",
        lambda kernel: _crowd(1_000_000, math.log(1e-6), 1e-4, kernel),
        kernels=(Kernel.BETA,),
        bound=1e-4,
    ),
)


def _about_x(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
