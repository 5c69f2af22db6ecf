"""Edges that masks know: neighbours that views put into different regions are hardly one thing.

Place and colour make the graph of a scene (`liftcore.scene.neighbours`), and neither tells a white cup from the white
cloth below it. Masks do. With s_jk the number of views in which neighbours j and k belong to one region
(`liftcore.solve.membership`), and d_jk of those in which they belong to two, of each level, the affinity becomes

    a_jk P(one thing | s_jk, d_jk),   P = (1 - pi) B_0 / ((1 - pi) B_0 + pi B_1),   B_i = p_i^d (1 - p_i)^s

Neighbours are of two kinds, those in one thing and those across an edge; p_0 and p_1 say how often a view parts
neighbours of a kind, and pi how many lie across an edge. All three are the scene's own, the likeliest for the counts
of its edges (expectation maximisation of a mixture of two binomials): masks that are often split have a large p_0,
which then says little, and masks that often merge things a small p_1. Cells of grids take no part. Where no view says
anything, the affinity stays as it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from liftcore.runtime.jit import kernel
from liftcore.solve.membership import RegionGroups, memberships
from liftcore.values.region_weights import RegionWeights, run_each

if TYPE_CHECKING:
    from liftcore.scene.neighbours import SplatGraph

MOST = 64  # views that count of either kind: more say nothing new
ROUNDS = 100  # of expectation maximisation, which are enough
ROWS = 1 << 13  # splats of one piece of work


def weaken_edges(
    graph: SplatGraph, W: RegionWeights, levels: np.ndarray, threads: int | None = None
) -> tuple[SplatGraph, float]:
    """Weaken the graph's edges where masks part neighbours.

    Args:
        W: of all views, a row for every splat, on the CPU. levels: [M] i8, -1 for cells of grids.
        threads: None takes the cores that this process may use. The number changes no bit.

    Returns:
        The graph, and the share of all affinities that it lost.
    """
    if not (levels >= 0).any() or not graph.affinities.size:
        return graph, 0.0
    groups, indptr = RegionGroups.of(W.offsets.numpy(), levels), W.indptr.numpy()
    own = memberships(W, groups, threads).own
    pieces = [(first, min(first + ROWS, len(graph.order))) for first in range(0, len(graph.order), ROWS)]
    counts = np.zeros(len(graph.order) + 1, np.int64)
    run_each(lambda first, last: count_own(first, last, graph.order, indptr, own, counts), pieces, threads)
    begins = np.cumsum(counts)
    region = np.empty(begins[-1], np.int32)
    source = graph.order, indptr, own, W.region.numpy(), begins, region
    run_each(lambda first, last: take_own(first, last, *source), pieces, threads)
    kinds = np.zeros(len(graph.neighbours), np.uint16)
    arrays = graph.starts, graph.neighbours, begins, region, groups.group, groups.views * groups.levels, kinds
    run_each(lambda first, last: count_views(first, last, *arrays), pieces, threads)
    shares = one_thing(np.bincount(kinds, minlength=(MOST + 1) ** 2).reshape(MOST + 1, -1))
    affinities = graph.affinities * shares.astype(np.float32).ravel()[kinds]
    before, after = (float(values.sum(dtype=np.float64)) for values in (graph.affinities, affinities))
    return replace(graph, affinities=affinities), 1.0 - after / before


def one_thing(edges: np.ndarray) -> np.ndarray:
    """P(one thing) by the number of views that join and that part two neighbours.

    Args:
        edges: [MOST + 1, MOST + 1], the number of edges by joining views s and parting views d.
    """
    joined, parted = np.indices(edges.shape)
    edges = np.where(joined + parted > 0, edges, 0).astype(np.float64)
    across = np.where(parted > joined, 0.9, 0.1)  # P(across an edge), as a majority of views says
    for _ in range(ROUNDS):
        kinds = edges * (1 - across), edges * across
        rates = [((kind * parted).sum() + 1) / ((kind * (joined + parted)).sum() + 2) for kind in kinds]
        share = (kinds[1].sum() + 1) / (edges.sum() + 2)
        odds = np.log(share / (1 - share)) + sum(
            sign * (parted * np.log(rate) + joined * np.log1p(-rate))
            for sign, rate in zip((-1, 1), rates, strict=True)
        )
        across = 1 / (1 + np.exp(-odds.clip(-700, 700)))
    return np.where(joined + parted > 0, 1 - across, 1.0)


@kernel
def count_own(first, last, order, indptr, own, counts):
    """The regions that the splats of rows first..last belong to, at the row + 1."""
    for j in range(first, last):
        for k in range(indptr[order[j]], indptr[order[j] + 1]):
            counts[j + 1] += own[k]


@kernel
def take_own(first, last, order, indptr, own, regions, begins, region):
    """Write these regions from begins[j] on."""
    for j in range(first, last):
        at = begins[j]
        for k in range(indptr[order[j]], indptr[order[j] + 1]):
            if own[k]:
                region[at] = regions[k]
                at += 1


@kernel
def count_views(first, last, starts, neighbours, begins, region, group, groups, kinds):
    """Number the edges of rows first..last by how many views join and part them: ``(MOST + 1) s + d``."""
    mine = np.full(groups, -1, np.int32)
    for j in range(first, last):
        for i in range(begins[j], begins[j + 1]):
            mine[group[region[i]]] = region[i]
        for n in range(starts[j], starts[j + 1]):
            joined = parted = 0
            for i in range(begins[neighbours[n]], begins[neighbours[n] + 1]):
                other = mine[group[region[i]]]
                joined += other == region[i]
                parted += 0 <= other != region[i]
            kinds[n] = (MOST + 1) * min(joined, MOST) + min(parted, MOST)
        for i in range(begins[j], begins[j + 1]):
            mine[group[region[i]]] = -1
