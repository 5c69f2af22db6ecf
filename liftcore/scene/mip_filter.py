"""The 3D smoothing filter of Mip-Splatting, which its files (and GOF's) keep beside the splats: ``filter_3D``.

Such a scene is trained with every Gaussian convolved with one of that standard deviation f, its opacity lowered by as
much as its volume grew (Yu et al. 2024, Eq. 8)::

    s' = sqrt(s^2 + f^2),   o' = o sqrt(prod s^2 / prod s'^2)
"""

from __future__ import annotations

import numpy as np

from liftcore.errors import InvalidSplats

FILTER = "filter_3D"


def filtered(
    log_scales: np.ndarray, opacity_logits: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log scales [P, 3] f32 and opacity logits [P] f32 with the filter in them.

    Args:
        log_scales: [P, 3] f32, as stored. opacity_logits: [P] f32, as stored.
        deviations: [P], f in scene units.

    Raises:
        InvalidSplats: a deviation is negative, NaN or infinite.
    """
    bad = ~(np.isfinite(deviations) & (deviations >= 0))
    if bad.any():
        got = f"{float(deviations[bad][0]):g} in splat {int(bad.argmax())}"
        raise InvalidSplats(FILTER, expected="finite values of zero or more", got=got, hint="export the splats again")
    scales, theta = log_scales.astype(np.float64), opacity_logits.astype(np.float64)
    with np.errstate(divide="ignore"):  # a deviation of zero changes nothing; so do logs of it
        widened = np.logaddexp(2 * scales, 2 * np.log(deviations.astype(np.float64))[:, None]) / 2
        # log of sigmoid(theta) and of what it loses, then the logit of their product
        lost = np.where(np.isinf(scales), -np.inf, scales - widened).sum(axis=1)
        lowered = -np.logaddexp(0.0, -theta) + np.where(deviations > 0, lost, 0.0)
        logits = lowered - np.log(-np.expm1(lowered))
    return widened.astype(np.float32), logits.astype(np.float32)
