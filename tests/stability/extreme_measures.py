"""Measurements of extreme inputs against exact arithmetic: weights of a view, and whole lifts.

The float64 reference is `liftcore.raster.reference`; of features, the dense definition of the closed form over it.
"""

import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

import liftcore as lc
from liftcore.evaluate.inspect import describe_cameras, describe_packs, describe_splats
from liftcore.io.splats import write_splats
from liftcore.lifting.files import lift_files
from liftcore.query.question import METHODS
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import DenseView, dense_view, reading_matrix
from liftcore.scene.compositing import Weighting
from liftcore.scene.splats import Kernel
from liftcore.solve.diagnostics import FAINT, order_warnings
from liftcore.values.pack import read_features, write_pack
from liftcore.values.views import ViewFeatures
from tests.inria_file import write_inria_cameras
from tests.properties.oracle import dense, one_region_a_ray, pixels_of
from tests.scenes import camera_at_origin, splats_at

KERNELS = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D, Kernel.BETA)
GAUSSIAN, DISC, BETA = (Kernel.GAUSSIAN_3D,), (Kernel.GAUSSIAN_2D,), (Kernel.BETA,)
FLOORED = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D)  # the kernels with a smallest alpha
WEIGHTS = 1e-5  # absolute, of weights against the float64 oracle


def always(_: object) -> bool:
    """No claim beyond equality with the oracle."""
    return True


@dataclass(frozen=True)
class Outcome:
    """The result of float32 on one extreme with one kernel."""

    error: float  # against exact arithmetic, as the case says
    text: tuple[str, ...] = ()  # warnings that the user reads
    holds: bool = True  # whether what exact arithmetic says is so, of the float64 and of the float32 result


@dataclass(frozen=True)
class Extreme:
    """One row of the table, and one test a kernel."""

    name: str
    measure: Callable[[Kernel], Outcome]
    kernels: tuple[Kernel, ...] = KERNELS
    bound: float = WEIGHTS  # of the error; the test holds it
    text: str = ""  # text that some message must contain; "" where no message is needed


# --- weights of a view ---


@dataclass(frozen=True)
class Comparison:
    """One view in float32 beside float64."""

    A: np.ndarray  # [H * W, P] f64, of the oracle
    got: np.ndarray  # [H * W, P] f64, of the float32 walk
    error: float  # the largest of all weights, their squares and row sums, away from the cut-offs
    finite: bool


def exact_view(splats: lc.Splats, camera: lc.Camera, params: lc.CompositingParams) -> DenseView:
    """The oracle; logits far below zero overflow its exponential on the way to an exact zero."""
    with np.errstate(over="ignore"):
        return dense_view(splats, camera, params)


def weights_of(
    splats: lc.Splats, camera: lc.Camera, params: lc.CompositingParams, power: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """A^p [H * W, P] and the total weight [P], through region weights with one region a pixel."""
    got = CpuRaster(splats, threads=2).region_weights(camera, one_region_a_ray(camera), params, Weighting(power))
    total_weight = np.zeros(splats.count)
    total_weight[got.total_weight_splats.numpy()] = got.total_weight.numpy()
    return dense(got, splats.count, camera.width * camera.height).T, total_weight


def trace_weights(splats: lc.Splats, camera: lc.Camera, params: lc.CompositingParams) -> np.ndarray:
    """A [H * W, P] by single rays, as the diagnostics take it."""
    rows = CpuRaster(splats, threads=1).ray_rows(camera, pixels_of(camera), params)
    A = np.zeros((camera.width * camera.height, splats.count))
    A[np.repeat(np.arange(A.shape[0]), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    return A


def compare(splats: lc.Splats, camera: lc.Camera, params: lc.CompositingParams | None = None) -> Comparison:
    """A by region weights, by single rays and squared, the row sums and the total weight, against the oracle."""
    params = params or lc.CompositingParams()
    exact = exact_view(splats, camera, params)
    weights, total_weight = weights_of(splats, camera, params)
    single, squares = trace_weights(splats, camera, params), weights_of(splats, camera, params, power=2)[0]
    sums = CpuRaster(splats, threads=2).row_sums(camera, params).numpy().ravel()
    errors = np.abs(np.concatenate([weights - exact.A, single - exact.A, squares - exact.A**2], axis=1)).max(axis=1)
    errors = np.maximum(errors, np.abs(sums - exact.A.sum(axis=1)))
    worst = float(errors[~exact.cut].max(initial=0))
    reference = (
        exact
        if params.opacity_logit_scale == 1
        else exact_view(splats, camera, replace(params, opacity_logit_scale=1.0))
    )
    if not reference.cut.any():
        total = reference.A.sum(axis=0)
        worst = max(worst, float((np.abs(total_weight - total) / np.maximum(total, 1)).max()))
    finite = all(bool(np.isfinite(part).all()) for part in (weights, single, squares, sums, total_weight))
    return Comparison(exact.A, weights, worst, finite)


@dataclass(frozen=True)
class View:
    """Splats, camera and compositing parameters of a view."""

    splats: lc.Splats
    camera: lc.Camera
    params: lc.CompositingParams


Scene = Callable[[Kernel], View]
CAMERA, DEFAULTS = camera_at_origin(), lc.CompositingParams()


def at(
    means: Sequence[Sequence[float]] | np.ndarray,
    log_scales: ArrayLike = -2.0,
    *,
    camera: lc.Camera = CAMERA,
    params: lc.CompositingParams = DEFAULTS,
    **options: Any,
) -> Scene:
    """Splats at the means, as ``splats_at`` takes them, of whatever kernel."""
    return lambda kernel: View(splats_at(means, log_scales, **options, kernel=kernel), camera, params)


def view_of(
    name: str, scene: Scene, claim: Callable[[np.ndarray], bool] = always, like: Scene | None = None, **options: Any
) -> Extreme:
    """An extreme whose weights are held to the oracle.

    Args:
        name: of the row. scene: the view, for a kernel.
        claim: what exact arithmetic says of A [H * W, P], of the oracle's and of the float32 raster's.
        like: another view that has the same A.
        options: kernels, bound and text of the Extreme.
    """

    def measure(kernel: Kernel) -> Outcome:
        view = scene(kernel)
        got = compare(view.splats, view.camera, view.params)
        pair = got.A, got.got
        exact = exact_weights(like(kernel)) if like else None
        is_equal = exact is None or all(float(np.abs(A - exact).max()) < WEIGHTS for A in pair)
        holds = got.finite and is_equal and all(claim(A) for A in pair)
        return Outcome(got.error, messages_of(view.splats, view.camera), holds)

    return Extreme(name, measure, **options)


def messages_of(splats: lc.Splats, camera: lc.Camera) -> tuple[str, ...]:
    """The warnings of ``inspect`` and of a lift on such splats and such a camera."""
    warnings = describe_splats(splats)["warnings"] + describe_cameras(lc.Cameras((camera,)))["warnings"]
    return tuple(warnings + order_warnings(splats, [camera]))


def exact_weights(view: View) -> np.ndarray:
    """The oracle's A [H * W, P] f64."""
    return exact_view(view.splats, view.camera, view.params).A


# --- whole lifts ---

WIDTH, HEIGHT = 16, 12
AWAY = "away"  # the view that looks where nothing is
CLOUD = 30  # splats
SUM = 2e-6  # of the longest value, for what is stored in float32
ALL_STEPS = {"preset": "default", "aggregation": True, "aggregation_cluster_size": 3}
ALL_STEPS |= {"reference_channels": 2}


def lift_of(
    name: str,
    views: ViewFeatures | Mapping[str, ViewFeatures],
    claim: Callable[[lc.LiftResult], bool] = always,
    *,
    splats: lc.Splats | None = None,
    settings: Mapping[str, Any] | None = None,
    bound: float = SUM,
    **options: Any,
) -> Extreme:
    """An extreme whose features are held to the dense definition, relative to the longest value that came in.

    All else that a lift may do after it (EVERYTHING), and questions by each threshold, must give finite numbers.

    Args:
        name: of the row. views: one, or several by name; AWAY looks where nothing is.
        claim: what exact arithmetic says of the lift. splats: None takes a random cloud.
        settings: of the lift. options: kernels and text of the Extreme.
    """
    by_name = views if isinstance(views, Mapping) else {"v0": views}

    def measure(kernel: Kernel) -> Outcome:
        scene_splats = splats or cloud(kernel)
        result, warnings = run(by_name, scene_splats, **(settings or {}))
        X, totals = dense_features(by_name, scene_splats, result.settings)
        longest = max(float(view.codebook.double().abs().max()) for view in by_name.values())
        faint = (totals > 0) & (totals < FAINT)
        errors = np.abs(result.features.double().numpy() - X) / (longest or 1.0)
        visible = result.has_feature.numpy()
        parts = result.features, result.total_weight
        sound = all(bool(part.isfinite().all()) for part in parts)
        sound &= (
            np.array_equal(visible[~faint], totals[~faint] > 0) and not result.features[~result.has_feature].any()
        )
        sound &= survives(
            run(by_name, scene_splats, **{**(settings or {}), **ALL_STEPS})[0], next(iter(by_name.values()))
        )
        messages = tuple(warnings + result.diagnostics["warnings"])
        return Outcome(float(errors[~faint].max(initial=0)), messages, bool(sound) and claim(result))

    return Extreme(name, measure, bound=bound, **options)


def cloud(kernel: Kernel = Kernel.GAUSSIAN_3D) -> lc.Splats:
    """Splats around the origin: needles, discs and balls, faint and opaque."""
    rng = np.random.default_rng(11)
    means, log_scales = rng.normal(0, 1, (CLOUD, 3)), rng.uniform(-4.5, -0.5, (CLOUD, 3))
    logits, quats = rng.normal(0, 3, CLOUD), rng.normal(0, 1, (CLOUD, 4))
    return splats_at(means, log_scales, logits, quats, kernel, logits)


def camera(name: str = "v0") -> lc.Camera:
    """Four units before the origin; AWAY a million behind it."""
    pose = np.eye(4)
    pose[2, 3] = -1e6 if name == AWAY else 4.0
    return lc.Camera.pinhole(name, WIDTH, HEIGHT, 16.0, 16.0, WIDTH / 2, HEIGHT / 2, pose)


def run(views: Mapping[str, ViewFeatures], splats: lc.Splats, **settings: Any) -> tuple[lc.LiftResult, list[str]]:
    """The lift, made through files, and the warnings of its pack; plain row-sum weights unless settings say else."""
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / part for part in ("splats.ply", "cameras.json", "pack.safetensors")]
        write_splats(paths[0], splats)
        write_inria_cameras(lc.Cameras(tuple(camera(view) for view in views)), paths[1])
        write_pack(paths[2], views, {"encoder": "by hand", "normalised": "false"})
        lift_settings = lc.LiftSettings.of(**{"preset": "row-sum", "dtype": "float32", **settings})
        result = lift_files(paths[0], paths[1], paths[2:], lift_settings)
        return result, describe_packs(read_features(paths[2]))["warnings"]


def dense_features(
    views: Mapping[str, ViewFeatures], splats: lc.Splats, settings: lc.LiftSettings
) -> tuple[np.ndarray, np.ndarray]:
    """``x_j = sum w^p b / sum w^p`` [P, F] f64 over the oracle's A, and the sums [P]."""
    sums, totals = 0.0, np.zeros(splats.count)
    for name, observation in views.items():
        S, ray = reading_matrix(observation, WIDTH, HEIGHT)
        weights = exact_view(splats, camera(name), settings.compositing).A[ray] ** settings.power
        sums = sums + weights.T @ (S @ observation.codebook.double().numpy())
        totals += weights.sum(axis=0)
    X = np.asarray(sums)
    return np.divide(X, totals[:, None], out=np.zeros_like(X), where=totals[:, None] > 0), totals


def survives(result: lc.LiftResult, view: ViewFeatures) -> bool:
    """Return True if all numbers of a lift and of queries to it are finite."""
    json.dumps(result.diagnostics, allow_nan=False)
    vector = view.codebook[:1].float()
    if not vector.any():
        return bool(result.features.isfinite().all())
    answers = [result.query(vector, threshold=method) for method in METHODS]
    parts = [result.features, *(torch.from_numpy(answer.scores) for answer in answers)]
    is_finite = all(
        not math.isnan(answer.threshold.value) and not answer.selected[~result.has_feature.numpy()].any()
        for answer in answers
    )
    return is_finite and all(bool(part.isfinite().all()) for part in parts)
