"""What an extreme is, and ways to measure one beside exact arithmetic: weights of a view, whole lifts, sums.

The float64 reference is `liftcore.raster.reference`; of features, the dense definition of the closed form over it.
"""

import json
import math
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.errors import SplatliftError
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions, ViewFeatures
from liftcore.io.inria import write_inria_cameras
from liftcore.io.inspect import describe_cameras, describe_packs, describe_splats
from liftcore.io.ply import write_splats
from liftcore.io.scene_files import lift_files
from liftcore.query.threshold import METHODS
from liftcore.raster.base import NEAR_PLANE, CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import DenseView, dense_view, projected_gaussian, reading_matrix
from liftcore.result import LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import LiftSettings
from liftcore.solve.diagnostics import FAINT, order_warnings
from tests.scenes import IDENTITY, of_kernel, splats_at

KERNELS = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D, Kernel.BETA)
GAUSSIAN = (Kernel.GAUSSIAN_3D,)
FLOORED = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D)  # the kernels with a smallest alpha
WEIGHTS = 1e-5  # absolute, of weights against the float64 oracle


def always(_: object) -> bool:
    """No claim beyond equality with the oracle."""
    return True


@dataclass(frozen=True)
class Found:
    """What float32 gave on one extreme with one kernel."""

    gives: str  # in figures, for people
    error: float | None  # against exact arithmetic, as the case says; None where the input is refused
    told: tuple[str, ...] = ()  # what the user reads: warnings, or the error
    holds: bool = True  # whether what exact arithmetic says is so, of the float64 and of the float32 result
    flips: int = 0  # rays within a hair of a cut-off where float32 decided otherwise; they are left out of the error
    rays: int = 0


@dataclass(frozen=True)
class Extreme:
    """One row of the table, and one test a kernel."""

    name: str
    measure: Callable[[Kernel], Found]
    kernels: tuple[Kernel, ...] = KERNELS
    bound: float = WEIGHTS  # of the error; the test holds it
    told: str = ""  # what some message must contain; "" where nothing is lost and nothing need be told


FLIP = 1e-5  # a weight that differs by more, on a ray near a cut-off, was decided otherwise


@dataclass(frozen=True)
class Comparison:
    """One view in float32 beside float64."""

    A: np.ndarray  # [H * W, P] f64, of the oracle
    got: np.ndarray  # [H * W, P] f64, of the float32 walk
    error: float  # the largest of all weights, their squares and row sums, away from the cut-offs
    rays: int
    near: int  # rays with some value within 1e-4 of a cut-off
    flips: int  # those of them that float32 decided otherwise
    finite: bool


def exact_view(splats: Splats, camera: Camera, walk: CompositingParams) -> DenseView:
    """The oracle; logits far below zero overflow its exponential on the way to an exact zero."""
    with np.errstate(over="ignore"):
        return dense_view(splats, camera, walk)


def weights_of(
    splats: Splats, camera: Camera, walk: CompositingParams, power: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """A^p [H * W, P] and the evidence [P], through region weights with one region a pixel."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    every_ray = Regions(labels, torch.ones(rays, 1))
    got = CpuRaster(splats, threads=2).region_weights(camera, every_ray, walk, Weighting(power))
    A = np.zeros((rays, splats.count))
    rows = np.repeat(got.splats.numpy(), np.diff(got.indptr.numpy()))
    A[got.region.numpy(), rows] = got.weight.numpy()
    evidence = np.zeros(splats.count)
    evidence[got.evidence_splats.numpy()] = got.evidence.numpy()
    return A, evidence


def traced(splats: Splats, camera: Camera, walk: CompositingParams) -> np.ndarray:
    """A [H * W, P] by single rays, as the certificate takes it."""
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)
    rows = CpuRaster(splats, threads=1).ray_rows(camera, pixels, walk)
    A = np.zeros((camera.width * camera.height, splats.count))
    A[np.repeat(np.arange(A.shape[0]), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    return A


def compare(splats: Splats, camera: Camera, walk: CompositingParams | None = None) -> Comparison:
    """A by region weights, by single rays and squared, the row sums and the evidence, against the oracle."""
    walk = walk or CompositingParams()
    exact = exact_view(splats, camera, walk)
    weights, evidence = weights_of(splats, camera, walk)
    single, squares = traced(splats, camera, walk), weights_of(splats, camera, walk, power=2)[0]
    sums = CpuRaster(splats, threads=2).row_sums(camera, walk).numpy().ravel()
    errors = np.abs(np.concatenate([weights - exact.A, single - exact.A, squares - exact.A**2], axis=1)).max(axis=1)
    errors = np.maximum(errors, np.abs(sums - exact.A.sum(axis=1)))
    worst = float(errors[~exact.cut].max(initial=0))
    plain = (
        exact if walk.opacity_logit_scale == 1 else exact_view(splats, camera, replace(walk, opacity_logit_scale=1.0))
    )
    if not plain.cut.any():
        total = plain.A.sum(axis=0)
        worst = max(worst, float((np.abs(evidence - total) / np.maximum(total, 1)).max()))
    finite = all(bool(np.isfinite(part).all()) for part in (weights, single, squares, sums, evidence))
    flips = int((errors[exact.cut] > FLIP).sum())
    return Comparison(exact.A, weights, worst, len(errors), int(exact.cut.sum()), flips, finite)


@dataclass(frozen=True)
class View:
    """What a view looks at, and how."""

    splats: Splats
    camera: Camera
    walk: CompositingParams = field(default_factory=CompositingParams)


def walked(
    name: str,
    scene: Callable[[Kernel], View],
    claim: Callable[[np.ndarray], bool] = always,
    like: Callable[[Kernel], np.ndarray] | None = None,
    **more: Any,
) -> Extreme:
    """An extreme whose weights are held to the oracle.

    Args:
        name: of the row. scene: the view, for a kernel.
        claim: what exact arithmetic says of A [H * W, P], of the oracle's and of the float32 raster's.
        like: what A equals, from another scene or camera, for a kernel; NaN where that says nothing.
        more: kernels, bound and told of the Extreme.
    """
    return Extreme(name, partial(_measure_view, scene, claim, like), **more)


def told_of(splats: Splats, camera: Camera) -> tuple[str, ...]:
    """The warnings of ``inspect`` and of a lift on such splats and such a camera."""
    warnings = describe_splats(splats)["warnings"] + describe_cameras(Cameras((camera,)))["warnings"]
    return tuple(warnings + order_warnings(splats, [camera]))


def exact_weights(view: View) -> np.ndarray:
    """The oracle's A [H * W, P] f64."""
    return exact_view(view.splats, view.camera, view.walk).A


def _measure_view(
    scene: Callable[[Kernel], View],
    claim: Callable[[np.ndarray], bool],
    like: Callable[[Kernel], np.ndarray] | None,
    kernel: Kernel,
) -> Found:
    view = scene(kernel)
    got = compare(view.splats, view.camera, view.walk)
    alike = like is None or all(float(np.nanmax(np.abs(A - like(kernel)))) < WEIGHTS for A in (got.A, got.got))
    met = int((got.got > 0).any(axis=0).sum())
    return Found(
        f"{met} of {view.splats.count} met, weights to {got.got.max(initial=0):.3g}",
        got.error,
        told_of(view.splats, view.camera),
        got.finite and alike and claim(got.A) and claim(got.got),
        got.flips,
        got.rays,
    )


FOLDER = "splatlift-extreme-"
WIDTH, HEIGHT = 16, 12
AWAY = "away"  # the view that looks where nothing is
CLOUD = 30  # splats


@dataclass(frozen=True)
class Task:
    """What is lifted, and how. A view named AWAY looks where nothing is."""

    views: Mapping[str, ViewFeatures]
    splats: Splats | None = None  # None is a random cloud
    settings: Mapping[str, Any] = field(default_factory=lambda: {"dtype": "float32"})


def lifted(name: str, task: Task, claim: Callable[[Any], bool] = always, **more: Any) -> Extreme:
    """An extreme whose features are held to the dense definition, relative to the longest value that came in.

    All else that a lift may do after it (EVERYTHING), and questions by each threshold, must give finite numbers.

    Args:
        name: of the row. task: what is lifted. claim: what exact arithmetic says of the lift.
        more: kernels, bound and told of the Extreme.
    """
    return Extreme(name, partial(_measure_lift, task, claim), **more)


def refused(name: str, work: Callable[[], object], told: str, **more: Any) -> Extreme:
    """An extreme that no answer could be right for: the input is refused, with ``told`` in the error."""
    return Extreme(name, partial(_refusal, work), told=told, **more)


def cloud(kernel: Kernel | None = None) -> Splats:
    """Splats around the origin: needles, discs and balls, faint and opaque."""
    rng = np.random.default_rng(11)
    splats = splats_at(
        rng.normal(0, 1, (CLOUD, 3)),
        rng.uniform(-4.5, -0.5, (CLOUD, 3)),
        rng.normal(0, 3, CLOUD),
        rng.normal(0, 1, (CLOUD, 4)),
    )
    return splats if kernel is None else of_kernel(splats, kernel, splats.opacity_logits)


def camera(name: str = "v0") -> Camera:
    """Four units before the origin; AWAY a million behind it."""
    pose = np.eye(4)
    pose[2, 3] = -1e6 if name == AWAY else 4.0
    return Camera.pinhole(name, WIDTH, HEIGHT, 16.0, 16.0, WIDTH / 2, HEIGHT / 2, pose)


def run(task: Task, splats: Splats) -> tuple[LiftResult, list[str]]:
    """The lift, made through files, and the warnings of its pack."""
    with tempfile.TemporaryDirectory(prefix=FOLDER) as name:
        folder = Path(name)
        paths = folder / "splats.ply", folder / "cameras.json", folder / "pack.safetensors"
        write_splats(splats, paths[0])
        write_inria_cameras(Cameras(tuple(camera(view) for view in task.views)), paths[1])
        write_pack(paths[2], task.views, {"encoder": "by hand", "normalised": "false"})
        made = lift_files(paths[0], paths[1], paths[2:], LiftSettings.of(**{"preset": "row-sum", **task.settings}))
        return made, describe_packs(read_features(*paths[2:]))["warnings"]


def dense_features(task: Task, splats: Splats, settings: LiftSettings) -> tuple[np.ndarray, np.ndarray]:
    """``x_j = sum w^p b / sum w^p`` [P, F] f64 over the oracle's A, and the sums [P]."""
    sums, totals = 0.0, np.zeros(splats.count)
    for name, observation in task.views.items():
        S, ray = reading_matrix(observation, WIDTH, HEIGHT)
        weights = exact_view(splats, camera(name), settings.lift_params).A[ray] ** settings.power
        sums = sums + weights.T @ (S @ observation.codebook.double().numpy())
        totals += weights.sum(axis=0)
    X = np.asarray(sums)
    return np.divide(X, totals[:, None], out=np.zeros_like(X), where=totals[:, None] > 0), totals


def _measure_lift(task: Task, claim: Callable[[LiftResult], bool], kernel: Kernel) -> Found:
    splats = task.splats or cloud(kernel)
    made, warnings = run(task, splats)
    X, totals = dense_features(task, splats, made.metadata.settings)
    longest = max(float(view.codebook.double().abs().max()) for view in task.views.values())
    faint = (totals > 0) & (totals < FAINT)
    errors = np.abs(made.features.double().numpy() - X) / (longest or 1.0)
    sound = bool(made.features.isfinite().all() & made.evidence.isfinite().all() & made.agreement.isfinite().all())
    sound &= _survives(task, splats)
    sound &= np.array_equal(made.seen.numpy()[~faint], totals[~faint] > 0) and not bool(
        made.features[~made.seen].any()
    )
    dtype = str(made.features.dtype).removeprefix("torch.")
    gives = f"{int(made.seen.sum())} of {splats.count} seen, {dtype}"
    if faint.any():
        gives += f"; {int(faint.sum())} too faint, off by {errors[faint].max():.2g}"
    told = tuple(warnings + made.metadata.certificate["warnings"])
    return Found(gives, float(errors[~faint].max(initial=0)), told, sound and claim(made))


EVERYTHING = {"preset": "default", "aggregation": True, "aggregation_cluster_size": 3}
EVERYTHING |= {"cg_steps": 3, "damping": 0.0, "reference_channels": 2}


def _survives(task: Task, splats: Splats) -> bool:
    """Whether least squares, reference, reweighting and aggregation give finite numbers, and questions a score."""
    made = run(replace(task, settings={**task.settings, **EVERYTHING}), splats)[0]
    json.dumps(made.diagnostics, allow_nan=False)
    asked = next(iter(task.views.values())).codebook[:1].float()
    if not asked.any():
        return bool(made.features.isfinite().all())
    answers = [made.query(asked, threshold=method) for method in METHODS]
    parts = [made.features, made.agreement, *(answer.scores for answer in answers)]
    found = all(not math.isnan(answer.threshold) and not answer.splats[~made.seen].any() for answer in answers)
    return found and all(bool(part.isfinite().all()) for part in parts)


def _refusal(work: Callable[[], object], _: Kernel) -> Found:
    try:
        work()
    except SplatliftError as error:
        return Found("refused", None, (re.sub(rf"\S*{FOLDER}[^/]*/", "", str(error)),))
    return Found("accepted", None, (), holds=False)


SCENES = 300
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


def survey(kernel: Kernel, scenes: int = SCENES) -> Survey:
    """Compare so many wide scenes with the oracle."""
    judged = rays = near = flips = 0
    error, finite = 0.0, True
    for seed in range(scenes):
        view = wide_view(seed, kernel)
        got = compare(view.splats, view.camera, view.walk)
        finite &= got.finite and bool(got.got.min(initial=0) >= 0 and got.got.sum(axis=1).max() <= 1 + 1e-5)
        if judgeable(view):
            judged += 1
            rays += got.rays
            near += got.near
            flips += got.flips
            error = max(error, got.error)
    return Survey(scenes, judged, rays, near, flips, error, finite)


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
