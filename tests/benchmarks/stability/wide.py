"""Random scenes over wide ranges of logits, scales, distances, lenses and walks, and how many of their rays flip.

A ray within 1e-4 of a cut-off (an alpha of 1/255, the stop) may be decided otherwise in float32: those that are, are
counted. Scenes whose projected covariance has a condition beyond CONDITION are walked, and not judged: there the
float64 oracle itself is short of digits, for it inverts the covariance. Discs are all judged: rays cross their
planes, and nothing is inverted.

The page measures the scenes of SEEDS, and so does its test, which holds the errors to BOUND.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from liftcore.raster.base import NEAR_PLANE, CompositingParams
from liftcore.raster.reference import projected_gaussian
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Kernel
from tests.benchmarks.stability.case import WEIGHTS
from tests.benchmarks.stability.walks import View
from tests.benchmarks.stability.weights import compare
from tests.scenes import IDENTITY, splats_at

SEEDS = range(300)
BOUND = WEIGHTS
CONDITION = 1e8
GAINS = (0.01, 0.5, 1.0, 1.2, 16.0)
CAPS = (0.5, 0.85, 0.98, 0.9998)  # no power of 1 - cap is a stop, as (1 - 0.99)^2 is: that tie has its own row
STOPS = (0.0, 1e-4, 0.05)


@dataclass(frozen=True)
class Survey:
    """What many wide scenes of one kernel gave."""

    scenes: int
    judged: int
    rays: int  # of the judged scenes
    near: int  # of those, within 1e-4 of a cut-off
    flips: int  # of those, decided otherwise
    error: float  # the largest of any weight elsewhere
    finite: bool  # in all scenes


def wide_view(seed: int, kernel: Kernel) -> View:
    """Up to forty splats somewhere in the cone of a camera, near or far, of any shape.

    Logits to +-1e4, footprints of 1e-6 to 1e3 pixels with axes up to 1e9 apart, depths of 0.003 to 1e6, focal lengths
    of a tenth to a thousand image widths, the camera anywhere within 100 units and turned in any way.
    """
    rng = np.random.default_rng(seed)
    width, height, count = (int(rng.integers(1, top)) for top in (33, 25, 41))
    focal = width * 10.0 ** rng.uniform(-1, 3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(rng), rng.uniform(-100, 100, 3)
    camera = Camera.pinhole("v0", width, height, focal, focal * rng.uniform(0.5, 2), width * 0.4, height * 0.6, pose)
    z = 10.0 ** rng.uniform(-2.5, 6, count)
    sides = rng.uniform(-1.5, 1.5, (count, 2)) * (width, height) / focal * z[:, None]
    means = (np.column_stack([sides, z]) - pose[:3, 3]) @ pose[:3, :3]
    log_scales = 0.5 * rng.uniform(-28, 14, (count, 3)) + np.log(z / focal)[:, None]
    logits = np.where(rng.random(count) < 0.2, rng.choice([-1e4, 1e4, 0.0], count), rng.uniform(-12, 12, count))
    quats = np.where(rng.random((count, 1)) < 0.1, IDENTITY, rng.normal(0, 1, (count, 4)))
    splats = splats_at(means, log_scales, logits, quats, kernel, rng.uniform(-6, 4, count))
    walk = CompositingParams(float(rng.choice(GAINS)), float(rng.choice(CAPS)), float(rng.choice(STOPS)))
    return View(splats, camera, walk)


def survey(kernel: Kernel) -> Survey:
    """Compare the scenes of SEEDS with the oracle."""
    judged = rays = near = flips = 0
    error, finite = 0.0, True
    for seed in SEEDS:
        view = wide_view(seed, kernel)
        got = compare(view.splats, view.camera, view.walk)
        finite &= got.finite and bool(got.got.min(initial=0) >= 0 and got.got.sum(axis=1).max() <= 1 + 1e-5)
        if judgeable(view):
            judged += 1
            rays += got.rays
            near += got.near
            flips += got.flips
            error = max(error, got.error)
    return Survey(len(SEEDS), judged, rays, near, flips, error, finite)


def judgeable(view: View) -> bool:
    """Whether the float64 oracle has digits enough for every splat before the camera."""
    splats, camera = view.splats, view.camera
    if splats.kernel is Kernel.GAUSSIAN_2D:
        return True
    z = splats.means.double().numpy() @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    ahead = np.flatnonzero(z >= NEAR_PLANE)
    return all(np.linalg.cond(projected_gaussian(splats, int(j), camera)[1]) < CONDITION for j in ahead)


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """[3, 3] f64, uniform."""
    rotation, triangle = np.linalg.qr(rng.normal(0, 1, (3, 3)))
    rotation *= np.sign(np.diag(triangle))
    if np.linalg.det(rotation) < 0:
        rotation[:, 0] *= -1
    return rotation
