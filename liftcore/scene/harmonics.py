"""Colours as spherical harmonics; a renderer adds .5 to their sum."""

import math

import numpy as np

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant spherical harmonic


def constant_terms(colours: np.ndarray) -> np.ndarray:
    """Return the constant terms [..., 3] f64 of view-independent colours [..., 3] in 0..1."""
    return (np.asarray(colours, np.float64) - 0.5) / SH_C0


def band_values(band: int, directions: np.ndarray) -> np.ndarray:
    """Return [n, 2 band + 1] f64, real spherical harmonics of unit vectors [n, 3], ordered and signed as 3DGS does.

    Column ``band + m`` is ``(-1)^m N d^|m|P_band/dz^|m|`` times the real (m >= 0) or imaginary part of
    ``(x + i y)^|m|``, N such that the square integrates to one.
    """
    x, y, z = np.asarray(directions, np.float64).T
    columns = np.empty((len(x), 2 * band + 1))
    for m in range(band + 1):
        legendre = np.polynomial.Legendre.basis(band).deriv(m)(z) if m else np.polynomial.Legendre.basis(band)(z)
        factorials = math.factorial(band - m) / math.factorial(band + m)
        size = (-1) ** m * math.sqrt((2 * band + 1) / (4 * math.pi) * factorials * (2 if m else 1))
        around = (x + 1j * y) ** m
        columns[:, band - m] = size * legendre * around.imag
        columns[:, band + m] = size * legendre * around.real  # the one column of m = 0, too
    return columns


def band_rotation(band: int, rotation: np.ndarray) -> np.ndarray:
    """Return [2 band + 1, 2 band + 1] f64, which rotates coefficients of a band by ``rotation`` [3, 3]."""
    directions = np.random.default_rng(band).normal(size=(8 * (2 * band + 1), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rotated = band_values(band, directions @ rotation)  # rows are R^T d
    return np.linalg.lstsq(band_values(band, directions), rotated, rcond=None)[0]


def rotate_bands(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotate all coefficients [n, K, 3] where they lie by ``rotation`` [3, 3] f64, and return them."""
    for band in range(round(sh.shape[1] ** 0.5)):
        rows = slice(band**2, (band + 1) ** 2)
        sh[:, rows] = np.einsum("ij,njc->nic", band_rotation(band, rotation), sh[:, rows])
    return sh
