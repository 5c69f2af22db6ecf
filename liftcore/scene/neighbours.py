"""The nearest splats of each splat, and their affinity in position and colour: the graph of a scene."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np

from liftcore.runtime.cores import cores
from liftcore.scene.harmonics import SH_C0

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

NEIGHBOURS = 16  # of each splat, the nearest by their centres
COLOUR_WIDTH = 0.1  # standard deviation of colours in 0..1, over all three channels
LEAST_AFFINITY = 1e-6  # of pairs in the graph: weaker ones move nothing
_PIECE = 1 << 12  # points whose neighbours are worked on at once: what is made of them stays in the cache
_JITTER = 1e-12  # of the farthest coordinate

T = TypeVar("T")


def map_nearest(
    means: np.ndarray, work: Callable[[np.ndarray, np.ndarray], T], threads: int | None = None
) -> list[T]:
    """Call ``work(rows, near)`` for all points in pieces, with the NEIGHBOURS nearest others of each.

    Args:
        means: [n, 3] f64, n at least one.
        work: takes ``rows`` [m] i32, of points that are near one another, and ``near`` [m, k] i32 with
            ``k = min(NEIGHBOURS + 1, n)``, the nearest first: each point is among its own.
        threads: None uses the cores of this process. The result is bitwise identical for any number.

    Returns:
        The results of ``work``, in an order that depends on the points alone.
    """
    from scipy.spatial import KDTree

    places = set_apart(means)
    tree = KDTree(places)
    # Leaf by leaf: points that are worked on one after the other have the same neighbours.
    order, neighbour_count = tree.indices.astype(np.int32), min(NEIGHBOURS + 1, len(means))

    def work_piece(first: int) -> T:
        rows = order[first : first + _PIECE]
        near = np.asarray(tree.query(places[rows], neighbour_count)[1], np.int32).reshape(len(rows), neighbour_count)
        return work(rows, near)

    with ThreadPoolExecutor(threads or cores()) as pool:
        return list(pool.map(work_piece, range(0, len(means), _PIECE)))


def set_apart(points: np.ndarray) -> np.ndarray:
    """Return points [n, d] f64, shifted by less than float32 resolves.

    Those at one place would make a leaf of a tree that no search can divide.
    """
    extent = float(np.abs(points).max()) or 1.0
    return points + _JITTER * extent * np.random.default_rng(0).random(points.shape)


@dataclass(frozen=True)
class SplatGraph:
    """The affinities of neighbouring splats, symmetric and without loops, in rows that are near in space.

    With d_jk the distance of centres and m_j the median of d_jk over the 16 nearest k of j::

        a_jk = exp(-(d_jk / m_j)^2 / 2) exp(-(|rgb_j - rgb_k| / 0.1)^2 / 2),  then the mean of a_jk and a_kj

    where a_jk is zero if k is not among the nearest of j. Colours are those of degree 0, the same from everywhere, in
    0..1; splats without colours have the first factor alone. Distances have no unit of their own.
    """

    order: np.ndarray  # [P] i32, the splat of each row
    starts: np.ndarray  # [P + 1] i64, of the rows' entries
    neighbours: np.ndarray  # [E] i32, rows, ascending within a row
    affinities: np.ndarray  # [E] f32, above LEAST_AFFINITY / 2, at most 1
    coloured: bool  # True if the splats have colours

    @classmethod
    def of(cls, splats: Splats, threads: int | None = None) -> Self:
        """Find the neighbours of all splats; the result is bitwise identical for any number of threads."""
        from scipy.sparse import csr_array

        means, colours = splats.means.cpu().numpy().astype(np.float64), base_colours(splats)

        def weigh(rows: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            near = near[:, 1:]  # the first is itself
            distances = np.linalg.norm(means[near] - means[rows][:, None], axis=2)
            exponents = (distances / _scales(distances)[:, None]) ** 2
            if colours is not None:
                exponents += (((colours[near] - colours[rows][:, None]) / COLOUR_WIDTH) ** 2).sum(axis=2)
            affinities = np.exp(-0.5 * exponents).astype(np.float32)
            affinities[affinities < LEAST_AFFINITY] = 0.0
            return rows, near, affinities

        parts = map_nearest(means, weigh, threads)
        order, near, affinities = (np.concatenate(part) for part in zip(*parts, strict=True))
        del parts
        count, width = near.shape
        rank = np.empty(count, np.int32)
        rank[order] = np.arange(count, dtype=np.int32)
        columns = rank[near].ravel()
        columns = columns.astype(np.int64) if columns.size > np.iinfo(np.int32).max // 2 else columns
        starts = np.arange(count + 1, dtype=columns.dtype) * width
        directed = csr_array((affinities.ravel() * np.float32(0.5), columns, starts), shape=(count, count))
        del near, affinities
        graph = csr_array(directed + directed.T)
        graph.setdiag(0.0) if graph.diagonal().any() else None
        graph.eliminate_zeros()
        graph.sort_indices()
        indices = graph.indices.astype(np.int32, copy=False)
        return cls(order, graph.indptr.astype(np.int64), indices, graph.data, colours is not None)


def base_colours(splats: Splats) -> np.ndarray | None:
    """Return [P, 3] f32 in 0..1, the colours of degree 0; None where the splats have none."""
    if splats.sh is None:
        return None
    return (0.5 + SH_C0 * splats.sh[:, 0].float()).clamp(0.0, 1.0).cpu().numpy()


def _scales(distances: np.ndarray) -> np.ndarray:
    """Return [m] f64 above zero: the median of the distances [m, k], else the largest, where points share a place."""
    if not distances.shape[1]:
        return np.ones(len(distances))
    medians, largest = np.median(distances, axis=1), distances.max(axis=1)
    return np.where(medians > 0, medians, np.where(largest > 0, largest, 1.0))
