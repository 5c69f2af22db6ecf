"""Extremes of one view: its weights in float32 beside the float64 oracle, and what ``inspect`` says of its inputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.io.inspect import describe_cameras, describe_splats
from liftcore.raster.base import CompositingParams
from liftcore.scene.cameras import Camera, Cameras
from liftcore.solve.lift_warnings import order_warnings
from tests.benchmarks.stability.case import WEIGHTS, Extreme, Found, always
from tests.benchmarks.stability.weights import compare, exact_view

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.scene.splats import Kernel, Splats


@dataclass(frozen=True)
class View:
    """What a view looks at, and how."""

    splats: Splats
    camera: Camera
    walk: CompositingParams = field(default_factory=CompositingParams)


def walked(
    name: str,
    exact: str,
    scene: Callable[[Kernel], View],
    claim: Callable[[np.ndarray], bool] = always,
    like: Callable[[Kernel], np.ndarray] | None = None,
    **more: Any,
) -> Extreme:
    """An extreme whose weights are held to the oracle.

    Args:
        name: of the row. exact: what exact arithmetic says.
        scene: the view, for a kernel.
        claim: ``exact`` as a function of A [H * W, P], of the oracle's and of the float32 walk's.
        like: what A equals by ``exact``, from another scene or camera, for a kernel; NaN where it says nothing.
        more: kernels, bound and told of the Extreme.
    """
    return Extreme(name, exact, partial(_measure, scene, claim, like), **more)


def told_of(splats: Splats, camera: Camera) -> tuple[str, ...]:
    """The warnings of ``inspect`` and of a lift on such splats and such a camera."""
    warnings = describe_splats(splats)["warnings"] + describe_cameras(Cameras((camera,)))["warnings"]
    return tuple(warnings + order_warnings(splats, [camera]))


def exact_weights(view: View) -> np.ndarray:
    """The oracle's A [H * W, P] f64."""
    return exact_view(view.splats, view.camera, view.walk).A


def _measure(
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
