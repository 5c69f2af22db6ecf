"""Splats that touch, and connected groups of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.scene.compositing import MAX_LOG_SCALE
from liftcore.scene.neighbours import map_nearest
from liftcore.scene.quaternions import rotation_matrices

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

REACH = 2.0  # standard deviations to which a splat touches


def touching(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """Put splats that touch, directly or through others, into one group.

    Two splats touch where ``|m_j - m_k| <= 2 (s_j + s_k)``, with s the standard deviation of each along the line
    between their centres, ``sqrt(d^T Sigma d)``: a rule without a length of its own, as scenes have no common unit.
    Each looks at its 16 nearest among the rows [n] i64; other splats do not connect. Returned are the numbers [n] i32
    of the rows' groups, from 0 in the order of their first rows.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    count, pairs = len(rows), touching_pairs(splats, rows)
    graph = csr_array((np.ones(len(pairs[0]), np.int8), pairs), shape=(count, count))
    return connected_components(graph, directed=True, connection="weak")[1]


def touching_pairs(splats: Splats, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return [m] and [m] i32, indices among rows [n] of pairs that touch, each once or twice."""
    if len(rows) < 2:
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    means = splats.means.cpu().numpy()[rows].astype(np.float64)
    shapes = np.concatenate([means, _covariances(splats, rows)], axis=1)

    def find_touching(index: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        touch = _touch(shapes[index], shapes[near])
        return np.repeat(index, touch.sum(axis=1)), near[touch]

    index, near = zip(*map_nearest(means, find_touching), strict=True)
    return np.concatenate(index), np.concatenate(near)


def _touch(splat_shapes: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return [m, k] bool, True where a splat [m, 9] touches a neighbour [m, k, 9]; each is centre and Sigma."""
    splat_shapes = splat_shapes[:, None]
    x, y, z = (near[..., axis] - splat_shapes[..., axis] for axis in range(3))
    squares = (x * x, y * y, z * z, x * y, x * z, y * z)
    # s |d| of both sides, so that nothing is divided by a distance of zero.
    spread, near_spread = np.zeros(x.shape), np.zeros(x.shape)
    for place, square in enumerate(squares, start=3):
        spread += splat_shapes[..., place] * square
        near_spread += near[..., place] * square
    reach = REACH * (np.sqrt(np.maximum(spread, 0.0)) + np.sqrt(np.maximum(near_spread, 0.0)))
    return squares[0] + squares[1] + squares[2] <= reach


def spreads_along(splats: Splats, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return [n] f64, the standard deviations of splats [n] along a unit vector [3] of their frame."""
    x, y, z = direction
    return np.sqrt(np.maximum(_covariances(splats, rows) @ (x * x, y * y, z * z, x * y, x * z, y * z), 0.0))


def _covariances(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """Return [n, 6] f64, Sigma of each splat: xx, yy, zz, and twice xy, xz, yz."""
    scales = np.exp(splats.log_scales.cpu().numpy()[rows].astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    axes = rotation_matrices(splats.quats.cpu().numpy()[rows])[:, :, : scales.shape[1]]  # a disc has two axes
    x, y, z = (axes * scales[:, None]).transpose(1, 2, 0)
    products = (x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z)
    return np.stack([product.sum(axis=0) for product in products], axis=1)
