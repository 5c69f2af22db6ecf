"""The kernel of a scene, for the walk: its splats activated, its constants in a view, its projection."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from liftcore.raster.constants import ALPHA_FLOOR, LARGEST_EXPONENT, LOW_PASS
from liftcore.raster.cpu.footprints import BETAS, GAUSSIANS, Discs
from liftcore.raster.cpu.projection import HALF_LOG2_E, Scene, axes_of, fades_of, opacities
from liftcore.raster.cpu.projection_2dgs import project_discs
from liftcore.raster.cpu.projection_ellipses import project_ellipses
from liftcore.raster.cpu.records import BETA_RECORD, DISC_RECORD, GAUSSIAN_RECORD
from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from liftcore.raster.cpu.footprints import Betas, Gaussians
    from liftcore.raster.cpu.projection import Targets, View
    from liftcore.scene.splats import Splats

LARGEST_BETA = 1e30  # such a kernel is a point; larger ones would leave float32

RECORDS = {Kernel.GAUSSIAN_3D: GAUSSIAN_RECORD, Kernel.GAUSSIAN_2D: DISC_RECORD, Kernel.BETA: BETA_RECORD}


def activated(splats: Splats, gain: float) -> Scene:
    """The splats with their opacities, ``sigmoid(gain theta)``, and how far they reach."""
    means, empty = np.ascontiguousarray(splats.means.numpy().T), np.empty(0)
    plain = opacities(splats, 1.0)
    return with_gain(Scene(means, axes_of(splats), empty, empty, plain, empty, _betas(splats)), splats, gain)


def with_gain(scene: Scene, splats: Splats, gain: float) -> Scene:
    """The same splats with another gain on their opacity logits."""
    opacity = scene.plain if gain == 1.0 else opacities(splats, gain)
    strongest = np.maximum(opacity, scene.plain)
    if splats.kernel is Kernel.BETA:
        with np.errstate(divide="ignore"):
            furthest = -np.expm1(-math.log(2.0) * LARGEST_EXPONENT / scene.beta)  # smaller falloffs count as none
        reach = np.where(strongest > 0, furthest, -1.0)
    else:
        reach = np.log2(np.maximum(strongest, ALPHA_FLOOR / 2) / ALPHA_FLOOR)
    return scene._replace(opacity=opacity, fade=fades_of(opacity), reach=reach)


def _betas(splats: Splats) -> np.ndarray:
    """[P] f64, ``4 exp(b)``; [0] for the kernels that have none."""
    if splats.beta is None:
        return np.empty(0)
    largest = math.log(LARGEST_BETA / 4.0)
    return 4.0 * np.exp(np.minimum(splats.beta.numpy().astype(np.float64), largest))


def kernel_in(view: View, kernel: Kernel) -> Gaussians | Betas | Discs:
    """The kernel's constants in a view; their class tells the compiled code which kernel it is."""
    if kernel is Kernel.GAUSSIAN_2D:
        return Discs(ALPHA_FLOOR, _disc_curvature(view))
    return BETAS if kernel is Kernel.BETA else GAUSSIANS


def _disc_curvature(view: View) -> float:
    """Of the low-pass of 2DGS, ``exp(-g / 2)`` with ``g = 2 |p - mu|^2`` in pixels of the full view."""
    return 2.0 * HALF_LOG2_E * LOW_PASS / view.low_pass


def project(
    bounds: tuple[int, int], scene: Scene, view: View, kernel: Kernel, antialiased: bool, targets: Targets
) -> int:
    """Footprints of the splats in ``bounds`` that touch the image, packed from its first row on; their number."""
    if kernel is Kernel.GAUSSIAN_2D:
        return project_discs(*bounds, scene, view, _disc_curvature(view), targets)
    unit = 1.0 if kernel is Kernel.BETA else HALF_LOG2_E
    return project_ellipses(*bounds, scene, view, unit, antialiased, targets)
