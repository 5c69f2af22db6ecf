"""What a lift cannot answer for, in sentences: what the user should know before trusting it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.raster.base import LOW_PASS, MAX_LOG_SCALE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import torch

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

MOSTLY = 0.5  # of the splats; below it, what was not seen is most of the answer
FAINT = 1e-30  # of a sum of weights: its terms come near the smallest numbers of float32
UNSEEN = "splats were reached by no labelled ray; their features are zero"
NAMES = 3  # that a sentence shows
SAMPLE = 10_000  # splats whose depths are looked at, evenly over the file


def lift_warnings(
    splats: Splats,
    views: Sequence[Camera],
    sums: np.ndarray,
    asked: str,
    stored: torch.dtype,
    facts: Mapping[str, Any],
) -> list[str]:
    """Warnings of a lift.

    Args:
        views: the cameras that were lifted. sums: [P] f64, of the weights of labelled rays, to their power.
        asked, stored: the type that features were to have, and have.
        facts: of the certificate: ``views_without_camera`` and ``views_without_splats``, names.
    """
    warnings = []
    skipped, empty = facts["views_without_camera"], facts["views_without_splats"]
    if skipped:
        told = f"{len(skipped)} views have features but no camera and were skipped: {_some(skipped)}"
        warnings.append(told + _folders_of(views))
    if empty:
        warnings.append(f"{len(empty)} of {len(views)} views meet no splat: {_some(empty)}")
    unseen, faint = int((sums == 0).sum()), int(((sums > 0) & (sums < FAINT)).sum())
    if unseen == len(sums):
        warnings.append("no labelled ray reached any splat: check that splats and cameras share their frame")
    elif unseen > MOSTLY * len(sums):
        warnings.append(f"{unseen} of {len(sums)} {UNSEEN}")
    if faint:
        warnings.append(f"{faint} of {len(sums)} splats weigh less than {FAINT:g}, where float32 loses digits")
    if asked not in str(stored):
        name = str(stored).removeprefix("torch.")
        warnings.append(f"features are stored as {name}: {asked} does not hold vectors of their length")
    return warnings + order_warnings(splats, views)


def order_warnings(splats: Splats, views: Sequence[Camera]) -> list[str]:
    """A warning where most splats lie so far from a camera that float32 depths are coarser than their footprints.

    Depths are sorted as float32, whose step at z is about ``z 2^-23``; splats within a step of each other are walked
    in the order of the file. A footprint is as large as its splat or its low-pass, whichever is larger.
    """
    step = -(-splats.count // SAMPLE)
    size = np.exp(splats.log_scales[::step].amax(dim=1).double().numpy().clip(max=MAX_LOG_SCALE))
    means = splats.means[::step].double().numpy()
    coarse = []
    for camera in views:
        z = means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        ahead = z > 0
        blur = math.sqrt(LOW_PASS) * z / max(camera.fx, camera.fy)
        steps = np.spacing(z.astype(np.float32))
        if ahead.any() and (steps > np.maximum(size, blur))[ahead].mean() > MOSTLY:
            coarse.append(camera.name)
    if not coarse:
        return []
    return [
        f"{len(coarse)} of {len(views)} views are so far from the splats that float32 depths cannot order most of "
        f"them: {_some(coarse)}"
    ]


def _folders_of(views: Sequence[Camera]) -> str:
    """What to do where cameras are named with their folders, as those of a rig are."""
    example = next((camera.name for camera in views if "/" in camera.name), None)
    return f"; cameras are named with their folders here, such as {example}: name views like them" if example else ""


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMES])
