"""Colours as spherical harmonics keep them; a renderer adds .5 to their sum."""

import numpy as np

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant spherical harmonic


def constant_terms(colours: np.ndarray) -> np.ndarray:
    """The constant terms [..., 3] f64 of the harmonics that show colours [..., 3] in 0..1, alike from everywhere."""
    return (np.asarray(colours, np.float64) - 0.5) / SH_C0
