"""Which splats hang together: components of the graph in which neighbours touch."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from liftcore.jit import kernel
from liftcore.raster.base import MAX_LOG_SCALE
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.splats import Splats

NEIGHBOURS = 16  # that each splat looks at, the nearest by their centres
REACH = 2.0  # standard deviations to which a splat touches
_PIECE = 1 << 15  # splats whose neighbours are looked at at once
_TOLD_APART = 1e-12  # of the farthest coordinate


def touching(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """Put splats that touch, directly or through others, into one group.

    Two splats touch where ``|m_j - m_k| <= 2 (s_j + s_k)``, with s the standard deviation of each along the line
    between their centres, ``sqrt(d^T Sigma d)``: a rule without a length of its own, as scenes have no common unit.
    Each looks at its 16 nearest among the rows.

    Args:
        splats: the scene.
        rows: [n] i64, the splats to group; the others do not connect.

    Returns:
        [n] i32, the number of each row's group, from 0 in the order of their first rows.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(rows)
    if count < 2:
        return np.zeros(count, np.int32)
    means = splats.means.numpy()[rows].astype(np.float64)
    spreads = _spreads(splats, rows)
    # Points at one place make a leaf that no search can divide: told apart by less than float32 can, they are.
    extent = float(np.abs(means).max()) or 1.0
    places = means + _TOLD_APART * extent * np.random.default_rng(0).random(means.shape)
    tree = KDTree(places)

    def look(first: int) -> tuple[np.ndarray, np.ndarray]:
        piece = slice(first, first + _PIECE)
        near = np.asarray(tree.query(places[piece], min(NEIGHBOURS + 1, count))[1])  # itself among them
        touch = np.empty(near.shape, np.bool_)
        find_touching(means, spreads, first, near, touch)
        return near[touch], touch.sum(axis=1)

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        looks = list(pool.map(look, range(0, count, _PIECE)))
    columns, sizes = (np.concatenate(parts) for parts in zip(*looks, strict=True))
    starts = np.concatenate([[0], np.cumsum(sizes)])
    graph = csr_array((np.ones(len(columns), np.int8), columns, starts), shape=(count, count))
    _, groups = connected_components(graph, directed=True, connection="weak")
    return groups


def warm_up_touching() -> None:
    """Compile what finds neighbours and load what searches them, before anyone waits for it."""
    two = Splats(torch.zeros(2, 3), torch.ones(2, 4), torch.zeros(2, 3), torch.zeros(2))
    touching(two, np.arange(2))


@kernel
def find_touching(means, spreads, first, near, touch):
    """Mark in ``touch`` [m, k] bool which of the rows ``near`` [m, k] the rows from ``first`` on touch.

    Args:
        means: [n, 3] f64. spreads: [n, 6] f64, of `_spreads`.
    """
    for place in range(near.shape[0]):
        own = first + place
        for number in range(near.shape[1]):
            other = near[place, number]
            x = means[other, 0] - means[own, 0]
            y = means[other, 1] - means[own, 1]
            z = means[other, 2] - means[own, 2]
            squares = (x * x, y * y, z * z, x * y, x * z, y * z)
            # s |d| of both sides, so that nothing is divided by a distance of zero.
            mine, theirs = 0.0, 0.0
            for k in range(6):
                mine += spreads[own, k] * squares[k]
                theirs += spreads[other, k] * squares[k]
            reach = REACH * (math.sqrt(max(mine, 0.0)) + math.sqrt(max(theirs, 0.0)))
            touch[place, number] = squares[0] + squares[1] + squares[2] <= reach


def _spreads(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """[n, 6] f64, Sigma of each splat: xx, yy, zz, and twice xy, xz, yz."""
    scales = np.exp(splats.log_scales.numpy()[rows].astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    turned = rotation_matrices(splats.quats.numpy()[rows])[:, :, : scales.shape[1]]  # a disc has two axes
    x, y, z = (turned * scales[:, None]).transpose(1, 2, 0)
    products = (x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z)
    return np.stack([product.sum(axis=0) for product in products], axis=1)
