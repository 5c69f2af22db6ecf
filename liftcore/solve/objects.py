"""Objects without words: regions that other views keep together are one thing. No feature is read.

Regions are nodes. With R as mask consensus has it (`liftcore.solve.consensus`), splats counting by ``sqrt(t_j)``, a
level of view v **sees** region m where it holds at least OBSERVES of it, and its region n **contains** m where n has
CONTAINS of what the level holds. View v observes a pair where it sees both, and supports it where a region of any of
its levels contains both, so that masks of a whole thing hold its parts together. Then::

    rate(A, B) = (sum of supporting views) / (sum of observing views)      over pairs of a region of A with one of B

and the two clusters of the highest rate become one, down to a rate of TOGETHER. That is average linkage in which a
pair counts as often as it was observed: opposite sides of a wall, which no view sees together, neither join nor part.
A rate of two clusters with a third lies between their own, so that neighbour chains find the same tree as a search
among all pairs does (Murtagh 1983). Compare MaskClustering (Yan et al., CVPR 2024), whose consensus rate this is.

A cluster with regions of LEAST_VIEWS views is an **object**. A splat belongs to the object whose regions weigh most
at it, if these have half of all objects' weight there. Objects are numbered by evidence, the largest first.

Memory and time are bounded: nodes are the regions of evenly chosen views, MOST_REGIONS at most, with two tables of
that square (134 MB); regions of other views then join the object that has most of them. Counts are whole numbers and
sums have the order of splats, so that the number of threads changes no bit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from liftcore.jit import kernel
from liftcore.solve.weights import RegionWeights, row_blocks, run_each

NO_OBJECT = -1
BELONGS, FAINT = 0.7, 0.05  # as for mask consensus: of a splat's weight in a level, and the least weight there
OBSERVES = 0.3  # of a region, that a level must see to say anything of it, likewise
CONTAINS = 0.7  # of what a level sees of a region: less, and the region lies across two others
TOGETHER = 0.5  # of the views that see two regions: most of them
LEAST_VIEWS = 3  # with a region of a thing: two may make the same mistake
MOST_REGIONS = 1 << 12
FEWEST_VIEWS = 16  # that give nodes, where there are so many, however many regions they have
MOST_SPLATS = 1 << 11  # of a region, evenly chosen: a share needs no more
BEST_VIEWS = 5  # that are kept of each object
BLOCK_ENTRIES = 1 << 18


@dataclass(frozen=True)
class _Nodes:
    """The regions that are clustered, and what belongs to each."""

    regions: np.ndarray  # [N] i64 ascending
    begins: np.ndarray  # [N + 1], where the splats of each begin
    splats: np.ndarray  # i32, ascending in a node
    starts: np.ndarray  # [P + 1], where the nodes of each splat begin
    members: np.ndarray  # i32, ascending in a splat
    counts: np.ndarray  # [P] f64, how much each splat counts


@dataclass(frozen=True)
class RegionObjects:
    """What the graph of regions holds together."""

    labels: np.ndarray  # [P] i32, the object of each splat; -1 for none
    views: np.ndarray  # [K, BEST_VIEWS] i32, the views that show most of each, best first; -1 after the last
    regions: np.ndarray  # [M] i32, the object of each region; -1 for none


def region_objects(
    W: RegionWeights, levels: np.ndarray, evidence: np.ndarray, threads: int | None = None
) -> RegionObjects:
    """The objects of a scene.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        evidence: [P], sums of plain weights; objects are numbered by it.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    view = np.repeat(np.arange(len(W.offsets) - 1), W.offsets.diff().numpy())
    nodes = _nodes(W, levels.astype(np.int64), view, threads)
    own = nodes.regions
    clusters = np.full(levels.size, NO_OBJECT, np.int32)
    if own.size:
        clusters[own] = _of_enough_views(clustered(*_graph(nodes, view[own], levels[own], threads)), view[own])
    number = int(clusters.max(initial=-1)) + 1
    labels = _labels(W, clusters, number, threads)
    left = np.flatnonzero((levels >= 0) & ~np.isin(view, view[own]))
    if number and left.size:
        clusters[left] = _joined(W, labels, number)[left]
        labels = _labels(W, clusters, number, threads)
    order = np.argsort(-np.bincount(labels[labels >= 0], evidence[labels >= 0], number), kind="stable")
    order = order[np.bincount(labels[labels >= 0], minlength=number)[order] > 0]  # without a splat it is none
    place = np.full(number + 1, NO_OBJECT, np.int32)  # the last is of -1
    place[order] = np.arange(order.size)
    labels = place[labels]
    return RegionObjects(labels, _best_views(W, labels, order.size), place[clusters])


def _nodes(W: RegionWeights, levels: np.ndarray, view: np.ndarray, threads: int | None) -> _Nodes:
    """The regions of evenly chosen views; of more than MOST_REGIONS those with the most splats."""
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    rows = indptr.size - 1
    masks = np.bincount(view[levels >= 0], minlength=len(W.offsets) - 1)
    showing = np.flatnonzero(masks)
    every = max(min(-(-int(masks.sum()) // MOST_REGIONS), showing.size // FEWEST_VIEWS), 1)
    while every * FEWEST_VIEWS < showing.size and masks[showing[::every]].sum() > MOST_REGIONS:
        every += 1
    chosen = np.isin(view, showing[::every]) & (levels >= 0)
    several = int(levels.max(initial=0)) + 1
    group = np.where(chosen, view * several + levels, -1).astype(np.int32)
    total, own, counts = np.zeros(rows), np.zeros(region.size, np.bool_), np.zeros(rows + 1, np.int64)
    numbers = view.astype(np.int32)
    run_each(
        lambda a, b: belong(a, b, indptr, region, weight, numbers, group, several, total, own, counts),
        row_blocks(np.diff(indptr), rows + 1, BLOCK_ENTRIES),
        threads,
    )
    starts = np.cumsum(counts)
    members = region[own]
    sizes = np.bincount(members, minlength=levels.size)
    nodes = np.sort(np.argsort(-sizes, kind="stable")[: min(MOST_REGIONS, int((sizes > 0).sum()))])
    number = np.full(levels.size, -1, np.int32)
    number[nodes] = np.arange(nodes.size)
    members = number[members]
    if nodes.size < int((sizes > 0).sum()):
        starts = np.concatenate([[0], np.cumsum(members >= 0)])[starts]
        members = members[members >= 0]
    by_splat = csr_array((np.ones(members.size, np.int8), members, starts), shape=(rows, nodes.size))
    by_node = by_splat.tocsc()
    return _Nodes(nodes, by_node.indptr, by_node.indices, starts, members, np.sqrt(total))


def _graph(nodes: _Nodes, view: np.ndarray, levels: np.ndarray, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
    """How many views support each pair of nodes, and how many observe it: [N, N] f32 each."""
    numbers = np.unique(view, return_inverse=True)[1]
    several, size, views = int(levels.max()) + 1, view.size, int(numbers.max()) + 1
    group = (numbers * several + levels).astype(np.int32)
    container = np.full((size, several * views), -1, np.int32)
    sees = np.zeros((size, views), np.float32)
    given = nodes.begins, nodes.splats, nodes.starts, nodes.members, nodes.counts
    run_each(
        lambda a, b: contain(a, b, *given, group, several, container, sees),
        row_blocks(np.diff(nodes.begins), size, BLOCK_ENTRIES >> 3),
        threads,
    )
    node, at = np.nonzero(container >= 0)
    held = csr_array((np.ones(node.size, np.int8), (node, container[node, at])), shape=(size, size)).tocsc()
    held.sort_indices()
    supporting = np.zeros((size, size), np.float32)
    blocks = [(first, min(first + 64, size)) for first in range(0, size, 64)]
    run_each(lambda a, b: support(a, b, container, several, held.indptr, held.indices, supporting), blocks, threads)
    return supporting, sees @ sees.T


def clustered(supporting: np.ndarray, observing: np.ndarray) -> np.ndarray:
    """[N] i64, the cluster of each node, from 0 in the order of their first nodes.

    Args:
        supporting, observing: [N, N] f32, symmetric; both are overwritten.
    """
    from scipy.sparse.csgraph import connected_components

    size = supporting.shape[0]
    pairs, rates = np.zeros((max(size - 1, 0), 2), np.int64), np.zeros(max(size - 1, 0))
    neighbour_chain(supporting, observing, pairs, rates)
    # Of nodes that stand for clusters: those of a merge that counts were merged at higher rates before.
    one, other = pairs[rates >= TOGETHER].T
    merged = csr_array((np.ones(one.size, np.int8), (one, other)), shape=(size, size))
    return connected_components(merged, directed=False)[1]


def _of_enough_views(clusters: np.ndarray, view: np.ndarray) -> np.ndarray:
    """[N] i32: clusters numbered anew, -1 for those with regions of fewer than LEAST_VIEWS views."""
    pairs = np.unique(np.stack([clusters, view]), axis=1)
    views = np.bincount(pairs[0])
    enough = views >= min(LEAST_VIEWS, np.unique(view).size)
    return np.where(enough, np.cumsum(enough) - 1, NO_OBJECT)[clusters].astype(np.int32)


def _labels(W: RegionWeights, clusters: np.ndarray, number: int, threads: int | None) -> np.ndarray:
    """[P] i32: the object of each splat."""
    labels = np.full(W.indptr.shape[0] - 1, NO_OBJECT, np.int32)
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    run_each(
        lambda a, b: elect(a, b, indptr, region, weight, clusters, number, labels),
        W.blocks(1 << 16, 1 << 20),
        threads,
    )
    return labels


def _joined(W: RegionWeights, labels: np.ndarray, number: int) -> np.ndarray:
    """[M] i32: the object that has over half of each region's weight, -1 where none has."""
    regions = int(W.offsets[-1])
    shares = csr_array((number + 1, regions), dtype=np.float64)
    for first, last in W.blocks(1 << 16, 1 << 20):
        own = slice(int(W.indptr[first]), int(W.indptr[last]))
        of_row = np.repeat(labels[first:last], W.indptr[first : last + 1].diff().numpy())
        parts = W.weight[own].double().numpy(), (of_row + 1, W.region[own].numpy())
        shares = shares + csr_array(parts, shape=(number + 1, regions))
    parts = shares.tocoo()
    totals = np.bincount(parts.col, parts.data, regions)
    most = (parts.row > 0) & (parts.data > totals[parts.col] / 2)  # one of a region at most
    joined = np.full(regions, NO_OBJECT, np.int32)
    joined[parts.col[most]] = parts.row[most] - 1
    return joined


def _best_views(W: RegionWeights, labels: np.ndarray, number: int) -> np.ndarray:
    """[K, BEST_VIEWS] i32: the views in which each object weighs most."""
    views = len(W.offsets) - 1
    shown = np.zeros((number, views))
    view = np.repeat(np.arange(views, dtype=np.int32), W.offsets.diff().numpy())
    show(labels, W.indptr.numpy(), W.region.numpy(), W.weight.numpy(), view, shown)
    best = np.full((number, BEST_VIEWS), -1, np.int32)
    order = np.argsort(-shown, axis=1, kind="stable")[:, :BEST_VIEWS]
    best[:, : order.shape[1]] = np.where(np.take_along_axis(shown, order, axis=1) > 0, order, -1)
    return best


@kernel
def belong(first, last, indptr, region, weight, view, group, several, total, own, counts):
    """For rows ``first..last``: their sums, which entries belong, and how many (at the row + 1)."""
    sums = np.zeros(several)
    for j in range(first, last):
        k, end = indptr[j], indptr[j + 1]
        while k < end:
            begin, v = k, view[region[k]]
            sums[:] = 0.0
            while k < end and view[region[k]] == v:
                total[j] += weight[k]
                if group[region[k]] >= 0:
                    sums[group[region[k]] - v * several] += weight[k]
                k += 1
            for n in range(begin, k):
                g = group[region[n]]
                if g >= 0:
                    most = sums[g - v * several]
                    if most > FAINT and weight[n] >= BELONGS * most:
                        own[n] = True
                        counts[j + 1] += 1


@kernel
def contain(first, last, begins, splats, starts, members, counts, group, several, container, sees):
    """For nodes ``first..last``: the node of each group that contains it, and which views see it."""
    R, seen = np.zeros(group.size), np.zeros(container.shape[1])
    most, largest = np.zeros(container.shape[1]), np.zeros(container.shape[1], np.int32)
    met = np.empty(group.size, np.int32)
    for m in range(first, last):
        found, size = 0, 0.0
        step = (begins[m + 1] - begins[m] + MOST_SPLATS - 1) // MOST_SPLATS
        for place in range(begins[m], begins[m + 1], step):
            j = splats[place]
            size += counts[j]
            for k in range(starts[j], starts[j + 1]):
                n = members[k]
                if R[n] == 0.0:
                    met[found] = n
                    found += 1
                R[n] += counts[j]
        for i in range(found):
            n = met[i]
            g = group[n]
            seen[g] += R[n]
            if R[n] > most[g] or (R[n] == most[g] and n < largest[g]):
                most[g], largest[g] = R[n], n
        for i in range(found):
            g = group[met[i]]
            if seen[g] >= OBSERVES * size:
                sees[m, g // several] = 1.0
                if most[g] >= CONTAINS * seen[g]:
                    container[m, g] = largest[g]
        for i in range(found):
            n = met[i]
            R[n], seen[group[n]], most[group[n]] = 0.0, 0.0, 0.0


@kernel
def support(first, last, container, several, begins, held, supporting):
    """For nodes ``first..last``: in how many views a region contains it and each other node, whatever the level."""
    told = np.full(container.shape[0], -1, np.int32)
    for m in range(first, last):
        told[:] = -1
        for g in range(container.shape[1]):
            c = container[m, g]
            if c >= 0:
                v = g // several
                for k in range(begins[c], begins[c + 1]):
                    n = held[k]
                    if told[n] != v:
                        told[n] = v
                        supporting[m, n] += 1.0


@kernel
def neighbour_chain(supporting, observing, pairs, rates):
    """Merge all nodes, each time two that are nearest to each other; a cluster keeps the row of its first node."""
    size, start, length = supporting.shape[0], 0, 0
    alive, chain = np.ones(size, np.bool_), np.empty(size + 1, np.int64)
    for merge in range(size - 1):
        if length == 0:
            while not alive[start]:
                start += 1
            chain[0], length = start, 1
        while True:
            a, best, rate = chain[length - 1], -1, -1.0
            if length > 1:
                best = chain[length - 2]
                rate = supporting[a, best] / observing[a, best] if observing[a, best] > 0 else 0.0
            for n in range(size):
                if alive[n] and n != a:
                    own = supporting[a, n] / observing[a, n] if observing[a, n] > 0 else 0.0
                    if own > rate:
                        best, rate = n, own
            if length > 1 and best == chain[length - 2]:
                break
            chain[length] = best
            length += 1
        length -= 2
        a, b = min(a, best), max(a, best)
        pairs[merge, 0], pairs[merge, 1], rates[merge] = a, b, rate
        alive[b] = False
        for n in range(size):
            if alive[n] and n != a:
                supporting[a, n] += supporting[b, n]
                observing[a, n] += observing[b, n]
                supporting[n, a], observing[n, a] = supporting[a, n], observing[a, n]


@kernel
def elect(first, last, indptr, region, weight, clusters, number, labels):
    """For splats ``first..last``: the object whose regions weigh most, if these are half of all objects' weight."""
    sums = np.zeros(number)
    for j in range(first, last):
        whole, best = 0.0, -1
        for k in range(indptr[j], indptr[j + 1]):
            c = clusters[region[k]]
            if c >= 0:
                sums[c] += weight[k]
                whole += weight[k]
                if best < 0 or sums[c] > sums[best]:
                    best = c
        if best >= 0 and 2.0 * sums[best] >= whole:
            labels[j] = best
        for k in range(indptr[j], indptr[j + 1]):
            c = clusters[region[k]]
            if c >= 0:
                sums[c] = 0.0


@kernel
def show(labels, indptr, region, weight, view, shown):
    """Add the weight [K, V] that each object has in each view."""
    for j in range(labels.size):
        if labels[j] >= 0:
            for k in range(indptr[j], indptr[j + 1]):
                shown[labels[j], view[region[k]]] += weight[k]
