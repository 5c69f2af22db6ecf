"""Extremes of one view: its weights in float32 beside the float64 oracle, and what ``inspect`` says of its inputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from liftcore.measure.stability.case import Extreme, Found
from liftcore.measure.stability.weights import compare
from liftcore.raster.protocol import Walk
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.inspect import describe_cameras, describe_splats
from liftcore.solve.lift_warnings import order_warnings

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from liftcore.scene.splats import Kernel, Splats


@dataclass(frozen=True)
class View:
    """What a view looks at, and how."""

    splats: Splats
    camera: Camera
    walk: Walk = field(default_factory=Walk)


def always(_: np.ndarray) -> bool:
    """No claim beyond equality with the oracle."""
    return True


def walked(
    name: str,
    exact: str,
    scene: Callable[[Kernel], View],
    claim: Callable[[np.ndarray], bool] = always,
    **more: Any,
) -> Extreme:
    """An extreme whose weights are held to the oracle.

    Args:
        name: of the row. exact: what exact arithmetic says.
        scene: the view, for a kernel.
        claim: ``exact`` as a function of A [H * W, P], of the oracle's and of the float32 walk's.
        more: kernels, bound and told of the Extreme.
    """
    return Extreme(name, exact, partial(_measure, scene, claim), **more)


def told_of(splats: Splats, camera: Camera) -> tuple[str, ...]:
    """The warnings of ``inspect`` and of a lift on such splats and such a camera."""
    warnings = describe_splats(splats)["warnings"] + describe_cameras(Cameras((camera,)))["warnings"]
    return tuple(warnings + order_warnings(splats, [camera]))


def _measure(scene: Callable[[Kernel], View], claim: Callable[[np.ndarray], bool], kernel: Kernel) -> Found:
    view = scene(kernel)
    got = compare(view.splats, view.camera, view.walk)
    met = int((got.got > 0).any(axis=0).sum())
    return Found(
        f"{met} of {view.splats.count} met, weights to {got.got.max(initial=0):.3g}",
        got.error,
        told_of(view.splats, view.camera),
        got.finite and claim(got.A) and claim(got.got),
        got.flips,
        got.rays,
    )
