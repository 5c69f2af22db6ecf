"""Edges from masks: weaker affinities between neighbours that views put into different regions.

The graph of a scene is built from positions and colours (`liftcore.scene.neighbours`), which do not separate a white
cup from the white cloth below it. Masks do. With s_jk the number of views in which neighbours j and k belong to one
region (`liftcore.solve.membership`), and d_jk of those in which they belong to two, over all levels, the affinity
becomes

    a_jk P(one object | s_jk, d_jk),   P = (1 - pi) B_0 / ((1 - pi) B_0 + pi B_1),   B_i = p_i^d (1 - p_i)^s

Neighbours lie within one object or across an edge; p_0 and p_1 are the rates at which views separate neighbours of
either kind, and pi is the share of pairs across an edge. All three are estimated from the scene's counts by maximum
likelihood (expectation maximisation of a mixture of two binomials): masks that are often split give a large p_0, so
that separation means little, and masks that often merge objects give a small p_1. Cells of grids are ignored. Without
an observation the affinity does not change.
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

MOST_VIEWS = 64  # largest counts s and d that are distinguished
ROUNDS = 100  # of expectation maximisation
ROWS = 1 << 13  # splats per task


def weaken_edges(
    graph: SplatGraph, W: RegionWeights, levels: np.ndarray, threads: int | None = None
) -> tuple[SplatGraph, float]:
    """Weaken the graph's edges where masks separate neighbours.

    Args:
        W: of all views, a row for every splat, on the CPU. levels: [M] i8, -1 for cells of grids.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.

    Returns:
        The graph, and the share of all affinities that it lost.
    """
    if not (levels >= 0).any() or not graph.affinities.size:
        return graph, 0.0
    groups, indptr = RegionGroups.of(W.offsets.numpy(), levels), W.indptr.numpy()
    own_region = memberships(W, groups, threads).own_region
    pieces = [(first, min(first + ROWS, len(graph.order))) for first in range(0, len(graph.order), ROWS)]
    counts = np.zeros(len(graph.order) + 1, np.int64)
    run_each(lambda first, last: count_own(first, last, graph.order, indptr, own_region, counts), pieces, threads)
    begins = np.cumsum(counts)
    region = np.empty(begins[-1], np.int32)
    source = graph.order, indptr, own_region, W.region.numpy(), begins, region
    run_each(lambda first, last: take_own(first, last, *source), pieces, threads)
    kinds = np.zeros(len(graph.neighbours), np.uint16)
    arrays = graph.starts, graph.neighbours, begins, region, groups.group, groups.views * groups.levels, kinds
    run_each(lambda first, last: count_views(first, last, *arrays), pieces, threads)
    shares = same_object_probability(np.bincount(kinds, minlength=(MOST_VIEWS + 1) ** 2).reshape(MOST_VIEWS + 1, -1))
    affinities = graph.affinities * shares.astype(np.float32).ravel()[kinds]
    before, after = (float(values.sum(dtype=np.float64)) for values in (graph.affinities, affinities))
    return replace(graph, affinities=affinities), 1.0 - after / before


def same_object_probability(edges: np.ndarray) -> np.ndarray:
    """Return P(one object) by the numbers of views that join and that separate two neighbours.

    Args:
        edges: [MOST_VIEWS + 1, MOST_VIEWS + 1], the number of edges by joining views s and separating views d.
    """
    joining, parting = np.indices(edges.shape)
    edges = np.where(joining + parting > 0, edges, 0).astype(np.float64)
    across = np.where(parting > joining, 0.9, 0.1)  # P(across an edge), initialised by majority
    for _ in range(ROUNDS):
        kinds = edges * (1 - across), edges * across
        rates = [((kind * parting).sum() + 1) / ((kind * (joining + parting)).sum() + 2) for kind in kinds]
        share = (kinds[1].sum() + 1) / (edges.sum() + 2)
        odds = np.log(share / (1 - share)) + sum(
            sign * (parting * np.log(rate) + joining * np.log1p(-rate))
            for sign, rate in zip((-1, 1), rates, strict=True)
        )
        across = 1 / (1 + np.exp(-odds.clip(-700, 700)))
    return np.where(joining + parting > 0, 1 - across, 1.0)


@kernel
def count_own(first, last, order, indptr, own_region, counts):
    """Count the regions of the splats of rows first..last, at index row + 1."""
    for j in range(first, last):
        for k in range(indptr[order[j]], indptr[order[j] + 1]):
            counts[j + 1] += own_region[k]


@kernel
def take_own(first, last, order, indptr, own_region, regions, begins, region):
    """List the regions of the splats of rows first..last, from begins[j] on."""
    for j in range(first, last):
        at = begins[j]
        for k in range(indptr[order[j]], indptr[order[j] + 1]):
            if own_region[k]:
                region[at] = regions[k]
                at += 1


@kernel
def count_views(first, last, starts, neighbours, begins, region, group, groups, kinds):
    """Encode the numbers of joining and separating views of edges: ``(MOST_VIEWS + 1) s + d``."""
    own_regions = np.full(groups, -1, np.int32)
    for j in range(first, last):
        for i in range(begins[j], begins[j + 1]):
            own_regions[group[region[i]]] = region[i]
        for n in range(starts[j], starts[j + 1]):
            joining = parting = 0
            for i in range(begins[neighbours[n]], begins[neighbours[n] + 1]):
                other = own_regions[group[region[i]]]
                joining += other == region[i]
                parting += 0 <= other != region[i]
            kinds[n] = (MOST_VIEWS + 1) * min(joining, MOST_VIEWS) + min(parting, MOST_VIEWS)
        for i in range(begins[j], begins[j + 1]):
            own_regions[group[region[i]]] = -1
