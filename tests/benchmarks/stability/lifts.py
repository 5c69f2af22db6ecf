"""Extremes of features: whole lifts through the files, beside the dense float64 definition of the closed form."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import SplatliftError
from liftcore.features.pack import read_features, write_pack
from liftcore.io.inria import write_inria_cameras
from liftcore.io.inspect import describe_packs
from liftcore.io.lift_files import lift_files
from liftcore.io.ply import write_splats
from liftcore.raster.reference import reading_matrix
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings
from liftcore.solve.lift_warnings import FAINT
from tests.benchmarks.stability.case import Extreme, Found, always
from tests.benchmarks.stability.weights import exact_view
from tests.scenes import of_kernel, splats_at

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from liftcore.features.views import ViewFeatures
    from liftcore.result import LiftResult
    from liftcore.scene.splats import Kernel

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


def lifted(
    name: str, exact: str, task: Callable[[], Task], claim: Callable[[Any], bool] = always, **more: Any
) -> Extreme:
    """An extreme whose features are held to the dense definition, relative to the longest value that came in.

    Args:
        name: of the row. exact: what exact arithmetic says.
        task: what is lifted.
        claim: ``exact`` as a function of the Lift.
        more: kernels, bound and told of the Extreme.
    """
    return Extreme(name, exact, partial(_measure, task, claim), **more)


def refused(name: str, exact: str, work: Callable[[], object], told: str, **more: Any) -> Extreme:
    """An extreme that no answer could be right for: the input is refused, with ``told`` in the error."""
    return Extreme(name, exact, partial(_refusal, work), told=told, **more)


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


def _measure(task_of: Callable[[], Task], claim: Callable[[LiftResult], bool], kernel: Kernel) -> Found:
    task = task_of()
    splats = task.splats or cloud(kernel)
    made, warnings = run(task, splats)
    X, totals = dense_features(task, splats, made.metadata.settings)
    longest = max(float(view.codebook.double().abs().max()) for view in task.views.values())
    faint = (totals > 0) & (totals < FAINT)
    errors = np.abs(made.features.double().numpy() - X) / (longest or 1.0)
    sound = bool(made.features.isfinite().all() & made.evidence.isfinite().all() & made.agreement.isfinite().all())
    sound &= np.array_equal(made.seen.numpy()[~faint], totals[~faint] > 0) and not bool(
        made.features[~made.seen].any()
    )
    dtype = str(made.features.dtype).removeprefix("torch.")
    gives = f"{int(made.seen.sum())} of {splats.count} seen, {dtype}"
    if faint.any():
        gives += f"; {int(faint.sum())} too faint, off by {errors[faint].max():.2g}"
    told = tuple(warnings + made.metadata.certificate["warnings"])
    return Found(gives, float(errors[~faint].max(initial=0)), told, sound and claim(made))


def _refusal(work: Callable[[], object], _: Kernel) -> Found:
    try:
        work()
    except SplatliftError as error:
        return Found("refused", None, (re.sub(rf"\S*{FOLDER}[^/]*/", "", str(error)),))
    return Found("accepted", None, (), holds=False)
