"""Conjugate gradients on small dense systems."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.solve.least_squares import Stopping, column_dots, conjugate_gradients


def system(kind: str, seed: int = 0, size: int = 12, channels: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A symmetric matrix that is at least zero, and right sides in its range."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    if kind == "scaled":  # what a Jacobi preconditioner is for
        root *= np.logspace(-2, 2, size)
    if kind == "deficient":
        root[size // 2 :] = root[: size - size // 2]
    K = root.T @ root
    return K.astype(np.float32), (K @ rng.normal(size=(size, channels))).astype(np.float32)


def jacobi(K: np.ndarray) -> np.ndarray:
    return (1 / np.diag(K)).astype(np.float32)


@pytest.mark.parametrize("kind", ["plain", "scaled", "deficient"])
def test_the_system_is_solved(kind):
    K, right = system(kind)
    outcome = conjugate_gradients(lambda X: K @ X, right, jacobi(K), Stopping(200, 1e-5))
    assert outcome.converged.all()
    assert not outcome.broken.any()
    assert np.abs(K @ outcome.solution - right).max() < 1e-3 * np.abs(right).max()
    assert np.abs(outcome.rest - (right - K @ outcome.solution)).max() < 1e-3 * np.abs(right).max()


def test_every_channel_is_solved_as_if_it_were_alone():
    K, right = system("plain")
    together = conjugate_gradients(lambda X: K @ X, right, jacobi(K), Stopping(6)).solution
    for channel in range(right.shape[1]):
        alone = conjugate_gradients(lambda X: K @ X, right[:, [channel]], jacobi(K), Stopping(6)).solution
        assert np.allclose(alone[:, 0], together[:, channel], rtol=1e-3, atol=1e-4)


def test_channels_that_are_done_cost_no_products():
    K, right = system("plain")
    right[:, 0] = 0
    widths = []

    def product(X: np.ndarray) -> np.ndarray:
        widths.append(X.shape[1])
        return K @ X

    outcome = conjugate_gradients(product, right, jacobi(K), Stopping(100, 1e-5))
    assert widths[0] == right.shape[1] - 1
    assert sum(widths) < right.shape[1] * outcome.steps
    assert (outcome.solution[:, 0] == 0).all()
    assert outcome.converged.all()


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan, np.inf])
def test_a_matrix_without_curvature_stops_and_says_so(bad):
    K, right = system("plain")
    with np.errstate(invalid="ignore", over="ignore"):
        outcome = conjugate_gradients(lambda X: X * np.float32(bad), right, jacobi(K), Stopping(20))
    assert outcome.broken.all()
    assert outcome.steps == 1
    assert np.isfinite(outcome.solution).all()


def test_rows_without_a_preconditioner_stay_zero():
    K, right = system("plain")
    inverse = jacobi(K)
    inverse[3] = 0
    outcome = conjugate_gradients(lambda X: K @ X, right, inverse, Stopping(200, 1e-5))
    others = np.delete(np.arange(len(K)), 3)
    expected = np.linalg.solve(K[np.ix_(others, others)].astype(np.float64), right[others])
    assert (outcome.solution[3] == 0).all()
    assert np.allclose(outcome.solution[others], expected, rtol=1e-2, atol=1e-2)


def test_an_exception_of_the_watcher_stops_the_work():
    K, right = system("plain")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        conjugate_gradients(lambda X: K @ X, right, jacobi(K), Stopping(20), stop)


def test_inner_products_are_summed_in_float64():
    left = np.full((100_000, 2), 1e-3, np.float32)
    left[0] = 1e4
    assert np.allclose(column_dots(left, np.ones_like(left)), left.astype(np.float64).sum(axis=0), rtol=1e-12)
