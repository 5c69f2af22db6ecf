"""Principal axes of a sample of vectors, the same to the bit on any number of cores."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

EXACT_CHANNELS = 1_024  # up to here all eigenvectors at once; beyond, the cost grows with the cube of F
_OVERSAMPLE = 16  # more directions than asked for, so that the last ones are found well too
_ITERATIONS = 6
_SEED = 0


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Products of NumPy on one thread each: their sums have one order then, whatever the machine's cores."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def principal_axes(centred: np.ndarray, count: int) -> np.ndarray:
    """The directions of the largest variance.

    All eigenvectors of the covariance where F is small; subspace iteration from a seeded start (Halko, Martinsson
    and Tropp 2011) where it is not. Signs are fixed: the largest entry of an axis is positive.

    Args:
        centred: [n, F] f32, a sample without its mean.
        count: how many axes at most.

    Returns:
        [F, min(count, F)] f32, orthonormal columns, the largest variance first.
    """
    channels = centred.shape[1]
    count = min(count, channels)
    with one_blas_thread():
        if channels <= EXACT_CHANNELS:
            covariance = (centred.T @ centred).astype(np.float64)
            axes = np.linalg.eigh(covariance)[1][:, ::-1][:, :count]
        else:
            axes = _subspace(centred, count)
    rows = np.abs(axes).argmax(axis=0)
    return (axes * np.sign(axes[rows, np.arange(count)])).astype(np.float32)


def _subspace(centred: np.ndarray, count: int) -> np.ndarray:
    width = min(count + _OVERSAMPLE, centred.shape[1])
    start = np.random.default_rng(_SEED).standard_normal((centred.shape[1], width)).astype(np.float32)
    basis = np.linalg.qr(start)[0]
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(centred.T @ (centred @ basis))[0]
    shown = (centred @ basis).astype(np.float64)
    turn = np.linalg.eigh(shown.T @ shown)[1][:, ::-1][:, :count]
    return basis @ turn
