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

**How it splits.** What contains a node is a function of MOST_SPLATS of its splats and of the nodes that these belong
to, so blocks of views find it for their own nodes (`node_views`). The graph is the driver's. The object of a splat is
a function of its row of W (`object_labels`); the objects of the other regions and the best views are sums over
splats, taken by pieces (`object_shares`, `view_shares`).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from liftcore.runtime.jit import kernel
from liftcore.solve.consensus import SplatTuples
from liftcore.solve.membership import Memberships, RegionGroups, memberships
from liftcore.solve.sums import PieceSums, added, in_order, piece_sums, pieces
from liftcore.values.region_weights import RegionWeights, row_blocks, run_each

NO_OBJECT = -1
OBSERVES = 0.3  # of a region, that a level must see to say anything of it, as for mask consensus
CONTAINS = 0.7  # of what a level sees of a region: less, and the region lies across two others
TOGETHER = 0.5  # of the views that see two regions: most of them
LEAST_VIEWS = 3  # with a region of a thing: two may make the same mistake
MOST_REGIONS = 1 << 12
FEWEST_VIEWS = 16  # that give nodes, where there are so many, however many regions they have
MOST_SPLATS = 1 << 11  # of a region, evenly chosen: a share needs no more
BEST_VIEWS = 5  # that are kept of each object
BLOCK_ENTRIES = 1 << 18


@dataclass(frozen=True)
class NodeSplats:
    """The splats of some nodes, and the nodes, of all, that each of these splats belongs to."""

    begins: np.ndarray  # [n + 1], where the splats of each node begin
    splats: np.ndarray  # i32, ascending in a node
    starts: np.ndarray  # [s + 1], where the nodes of each splat begin
    members: np.ndarray  # i32, numbers of nodes, ascending in a splat
    counts: np.ndarray  # [s] f64, how much each splat counts: sqrt(t_j)


@dataclass(frozen=True)
class NodeViews:
    """What levels and views say of some nodes."""

    container: np.ndarray  # [n, views * levels] i32, the node of each level that contains it; -1: none
    sees: np.ndarray  # [n, views] f32, one where the view sees it


@dataclass(frozen=True)
class RegionObjects:
    """What the graph of regions holds together."""

    labels: np.ndarray  # [P] i32, the object of each splat; -1 for none
    views: np.ndarray  # [K, BEST_VIEWS] i32, the views that show most of each, best first; -1 after the last
    regions: np.ndarray  # [M] i32, the object of each region; -1 for none


def region_objects(
    W: RegionWeights,
    levels: np.ndarray,
    evidence: np.ndarray,
    threads: int | None = None,
    *,
    members: Memberships | None = None,
) -> RegionObjects:
    """The objects of a scene whose W lies in one place.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        evidence: [P], sums of plain weights; objects are numbered by it.
        threads: None takes the cores that this process may use. The number changes no bit.
        members: of W, where they are known.
    """
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    members = members or memberships(W, groups, threads)
    sizes = np.bincount(W.region.numpy()[members.own], minlength=levels.size)
    nodes, others = choose_nodes(groups, sizes)
    table = node_splats(W, members, nodes, threads)
    clusters = node_clusters(nodes, groups, node_views(table, nodes, groups, threads), threads)
    number = int(clusters.max(initial=-1)) + 1
    labels = object_labels(W, clusters, number, threads)
    if number and others.size:
        join(clusters, others, object_shares(W, labels, number, others, threads), number)
        labels = object_labels(W, clusters, number, threads)
    shown = added(view_shares(W, groups, labels, number, threads), (1, number * groups.views))
    place = object_numbers(labels, evidence, number)
    return numbered(labels, clusters, place, shown.reshape(number, groups.views))


def choose_nodes(groups: RegionGroups, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The regions of evenly chosen views; of more than MOST_REGIONS those with the most splats.

    Args:
        sizes: [M], how many splats belong to each region.

    Returns:
        The nodes, [N] i64 ascending, and the masks of views that give none, [n] i64 ascending.
    """
    masks = np.bincount(groups.view[groups.group >= 0], minlength=groups.views)
    showing = np.flatnonzero(masks)
    every = max(min(-(-int(masks.sum()) // MOST_REGIONS), showing.size // FEWEST_VIEWS), 1)
    while every * FEWEST_VIEWS < showing.size and masks[showing[::every]].sum() > MOST_REGIONS:
        every += 1
    chosen = np.isin(groups.view, showing[::every]) & (groups.group >= 0)
    sizes = np.where(chosen, sizes, 0)
    nodes = np.sort(np.argsort(-sizes, kind="stable")[: min(MOST_REGIONS, int((sizes > 0).sum()))])
    giving = np.isin(groups.view, groups.view[nodes])
    return nodes, np.flatnonzero((groups.group >= 0) & ~giving)


def node_numbers(nodes: np.ndarray, regions: int) -> np.ndarray:
    """[M] i32: the number of each region among the nodes, -1 for none."""
    number = np.full(regions, -1, np.int32)
    number[nodes] = np.arange(nodes.size)
    return number


def node_splats(W: RegionWeights, members: Memberships, nodes: np.ndarray, threads: int | None = None) -> NodeSplats:
    """Of all nodes, from W of all views."""
    indptr, region = W.indptr.numpy(), W.region.numpy()
    number, starts = node_numbers(nodes, int(W.offsets[-1])), np.zeros(indptr.size, np.int64)
    blocks = W.blocks(1 << 16, BLOCK_ENTRIES << 2)
    run_each(lambda a, b: count_nodes(a, b, indptr, region, members.own, number, starts), blocks, threads)
    np.cumsum(starts, out=starts)
    found = np.empty(starts[-1], np.int32)
    run_each(lambda a, b: list_nodes(a, b, indptr, region, members.own, number, starts, found), blocks, threads)
    return NodeSplats(*by_node(starts, found, nodes.size), starts, found, np.sqrt(members.totals))


def sampled_splats(W: RegionWeights, own: np.ndarray, nodes: np.ndarray, base: int) -> tuple[np.ndarray, np.ndarray]:
    """The splats that speak for the nodes of some views: where those of each begin [n + 1] i64, and their rows of W.

    Args:
        W, own: as `memberships` has them, of the regions ``base..base + offsets[-1]``. nodes: [N] i64, of all views.
    """
    own_nodes = nodes[slice(*np.searchsorted(nodes, [base, base + int(W.offsets[-1])]))]
    number = node_numbers(own_nodes - base, int(W.offsets[-1]))
    entries = np.flatnonzero(own)
    members = number[W.region.numpy()[entries] - base]
    entries, members = entries[members >= 0], members[members >= 0]
    rows = np.repeat(np.arange(W.indptr.shape[0] - 1), W.indptr.diff().numpy())[entries]
    order = np.argsort(members, kind="stable")
    parts = [rows[part[:: max(-(-part.size // MOST_SPLATS), 1)]] for part in _split(order, members, own_nodes.size)]
    return np.cumsum([0, *(part.size for part in parts)]), np.concatenate([np.zeros(0, np.int64), *parts])


def _split(order: np.ndarray, members: np.ndarray, nodes: int) -> list[np.ndarray]:
    """The parts of an order by node, of which an empty one has no node."""
    return np.split(order, np.cumsum(np.bincount(members, minlength=nodes))[:-1]) if nodes else []


def sampled_nodes(
    begins: np.ndarray, splats: np.ndarray, tuples: SplatTuples, totals: np.ndarray, nodes: np.ndarray, regions: int
) -> NodeSplats:
    """Of the nodes of some views, from the tuples of the splats that speak for them.

    Args:
        begins, splats: where those of each node begin, and their numbers among the tuples' and totals'.
        tuples: of these splats in all views. totals: [s] f64, t_j. regions: M.
    """
    number, starts = node_numbers(nodes, regions), np.zeros(tuples.starts.size, np.int64)
    parts = tuples.starts, tuples.tuples, tuples.parents, tuples.members, number
    count_tuple_nodes(*[*parts, starts])
    np.cumsum(starts, out=starts)
    members = np.empty(starts[-1], np.int32)
    list_tuple_nodes(*[*parts, starts, members])
    return NodeSplats(begins, splats.astype(np.int32), starts, members, np.sqrt(totals))


def by_node(starts: np.ndarray, members: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the splats of each node begin, and these splats, from the nodes of each splat."""
    ones = np.ones(members.size, np.int8)
    table = csr_array((ones, members, starts), shape=(starts.size - 1, nodes)).tocsc()
    return table.indptr, table.indices


def node_views(table: NodeSplats, nodes: np.ndarray, groups: RegionGroups, threads: int | None = None) -> NodeViews:
    """What the levels and views of all nodes say of those of a table.

    Args:
        nodes: [N] i64, all of them, as the table's members number them.
    """
    number, group, views = _node_groups(nodes, groups)
    size = table.begins.size - 1
    found = NodeViews(np.full((size, groups.levels * views), -1, np.int32), np.zeros((size, views), np.float32))
    arrays = table.begins, table.splats, table.starts, table.members, table.counts
    run_each(
        lambda a, b: contain(a, b, *arrays, group, groups.levels, found.container, found.sees),
        row_blocks(np.diff(table.begins), max(size, 1), BLOCK_ENTRIES >> 3) if number.size else [],
        threads,
    )
    return found


def _node_groups(nodes: np.ndarray, groups: RegionGroups) -> tuple[np.ndarray, np.ndarray, int]:
    """The view of each node among those of nodes, [N] i64, its group among theirs [N] i32, and how many views."""
    view = groups.view[nodes]
    number = np.unique(view, return_inverse=True)[1]
    level = groups.group[nodes] - view * groups.levels
    return number, (number * groups.levels + level).astype(np.int32), int(number.max(initial=-1)) + 1


def node_clusters(
    nodes: np.ndarray, groups: RegionGroups, found: NodeViews, threads: int | None = None
) -> np.ndarray:
    """[M] i32: the cluster of each region, numbered from 0; -1 for regions of none.

    Args:
        found: of all nodes, in their order.
    """
    clusters = np.full(groups.view.size, NO_OBJECT, np.int32)
    if nodes.size:
        parts = clustered(*_graph(found, groups.levels, threads))
        clusters[nodes] = _of_enough_views(parts, groups.view[nodes])
    return clusters


def _graph(found: NodeViews, levels: int, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
    """How many views support each pair of nodes, and how many observe it: [N, N] f32 each."""
    container, size = found.container, len(found.container)
    node, at = np.nonzero(container >= 0)
    held = csr_array((np.ones(node.size, np.int8), (node, container[node, at])), shape=(size, size)).tocsc()
    held.sort_indices()
    supporting = np.zeros((size, size), np.float32)
    blocks = [(first, min(first + 64, size)) for first in range(0, size, 64)]
    run_each(lambda a, b: support(a, b, container, levels, held.indptr, held.indices, supporting), blocks, threads)
    return supporting, found.sees @ found.sees.T


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


def object_labels(W: RegionWeights, clusters: np.ndarray, number: int, threads: int | None = None) -> np.ndarray:
    """[n] i32: the cluster of each splat of a block, -1 for none.

    Args:
        W: of all views, a row for each splat of the block. clusters: [M] i32 below the number, -1 for none.
    """
    labels = np.full(W.indptr.shape[0] - 1, NO_OBJECT, np.int32)
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    run_each(
        lambda a, b: elect(a, b, indptr, region, weight, clusters, number, labels),
        W.blocks(1 << 16, 1 << 20),
        threads,
    )
    return labels


def object_shares(
    W: RegionWeights, labels: np.ndarray, number: int, others: np.ndarray, threads: int | None = None
) -> Iterator[PieceSums]:
    """The weight of some regions [n] i64 in each object at every piece of a block: [1, (number + 1) n], -1 first."""
    place, shape = node_numbers(others, int(W.offsets[-1])), (number + 1, others.size)

    def summed(first: int, last: int) -> PieceSums:
        lengths, whole = W.indptr[first : last + 1].diff().numpy(), csr_array(shape, dtype=np.float64)
        for a, b in row_blocks(lengths, last - first, BLOCK_ENTRIES):
            own = slice(int(W.indptr[first + a]), int(W.indptr[first + b]))
            columns = place[W.region[own].numpy()]
            kept = columns >= 0
            rows = np.repeat(labels[first + a : first + b] + 1, lengths[a:b])[kept]
            whole = whole + csr_array((W.weight[own].numpy()[kept].astype(np.float64), (rows, columns[kept])), shape)
        table = whole.tocoo()
        places = table.row.astype(np.int64) * others.size + table.col
        order = np.argsort(places)
        return PieceSums(places[order], table.data[None, order])

    return in_order(summed, pieces(W.indptr.shape[0] - 1), threads)


def join(clusters: np.ndarray, others: np.ndarray, shares: Iterable[PieceSums], number: int) -> None:
    """Regions of views without nodes take the cluster that has over half of their weight, in place.

    Args:
        clusters: [M] i32. others: [n] i64, these regions. shares: theirs (`object_shares`), of all splats.
    """
    shape = number + 1, others.size
    table = csr_array(shape, dtype=np.float64)
    for part in shares:
        table = table + csr_array((part.values[0], np.divmod(part.places, others.size)), shape=shape)
    found = table.tocoo()
    totals = np.bincount(found.col, found.data, others.size)
    most = (found.row > 0) & (found.data > totals[found.col] / 2)  # one of a region at most
    clusters[others[found.col[most]]] = found.row[most] - 1


def view_shares(
    W: RegionWeights, groups: RegionGroups, labels: np.ndarray, number: int, threads: int | None = None
) -> Iterator[PieceSums]:
    """The weight of each object in each view at every piece of a block: [1, number views]."""
    arrays = labels, W.indptr.numpy(), W.region.numpy(), W.weight.numpy(), groups.view, groups.views

    def add(first: int, last: int, table: np.ndarray) -> None:
        show(*[first, last, *arrays, table[0]])

    return piece_sums(add, labels.size, (1, number * groups.views), threads)


def object_numbers(labels: np.ndarray, evidence: np.ndarray, number: int) -> np.ndarray:
    """[K + 1] i32: the number of each cluster as an object, the most evidence first; -1 without a splat, and last.

    Args:
        labels: [P] i32, the cluster of each splat. evidence: [P]. number: K.
    """
    own = labels >= 0
    order = np.argsort(-np.bincount(labels[own], evidence[own], number), kind="stable")
    order = order[np.bincount(labels[own], minlength=number)[order] > 0]
    place = np.full(number + 1, NO_OBJECT, np.int32)
    place[order] = np.arange(order.size)
    return place


def numbered(labels: np.ndarray, clusters: np.ndarray, place: np.ndarray, shown: np.ndarray) -> RegionObjects:
    """The objects of a scene.

    Args:
        labels: [P] i32, the cluster of each splat. clusters: [M] i32, of each region. place: of `object_numbers`.
        shown: [K, V] f64, the weight of each cluster in each view.
    """
    order = np.argsort(place[:-1], kind="stable")[int((place[:-1] < 0).sum()) :]
    return RegionObjects(place[labels], _best_views(shown[order]), place[clusters])


def object_facts(found: RegionObjects) -> dict[str, Any]:
    """What the graph of regions held together, for the diagnostics."""
    share = float((found.labels >= 0).mean())
    return {"found": len(found.views), "splats_share": share, "regions": int((found.regions >= 0).sum())}


def _best_views(shown: np.ndarray) -> np.ndarray:
    """[K, BEST_VIEWS] i32: the views in which each object weighs most."""
    best = np.full((len(shown), BEST_VIEWS), -1, np.int32)
    order = np.argsort(-shown, axis=1, kind="stable")[:, :BEST_VIEWS]
    best[:, : order.shape[1]] = np.where(np.take_along_axis(shown, order, axis=1) > 0, order, -1)
    return best


@kernel
def count_nodes(first, last, indptr, region, own, number, counts):
    """The nodes that each of the splats ``first..last`` belongs to, at the splat + 1."""
    for j in range(first, last):
        for k in range(indptr[j], indptr[j + 1]):
            if own[k] and number[region[k]] >= 0:
                counts[j + 1] += 1


@kernel
def list_nodes(first, last, indptr, region, own, number, starts, members):
    """These nodes, from ``starts`` on."""
    for j in range(first, last):
        at = starts[j]
        for k in range(indptr[j], indptr[j + 1]):
            if own[k] and number[region[k]] >= 0:
                members[at] = number[region[k]]
                at += 1


@kernel
def count_tuple_nodes(begins, tuples, parents, members, number, counts):
    """The nodes that each splat belongs to by its tuples, at the splat + 1."""
    for j in range(begins.size - 1):
        for k in range(begins[j], begins[j + 1]):
            t = tuples[k]
            while t >= 0:
                counts[j + 1] += number[members[t]] >= 0
                t = parents[t]


@kernel
def list_tuple_nodes(begins, tuples, parents, members, number, starts, found):
    """These nodes, from ``starts`` on and ascending: a tuple names its regions from the last one to the first."""
    for j in range(begins.size - 1):
        at = starts[j + 1]
        for k in range(begins[j + 1] - 1, begins[j] - 1, -1):
            t = tuples[k]
            while t >= 0:
                if number[members[t]] >= 0:
                    at -= 1
                    found[at] = number[members[t]]
                t = parents[t]


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
def show(first, last, labels, indptr, region, weight, view, views, shown):
    """Add the weight [K V] that each object has in each view, of splats ``first..last``."""
    for j in range(first, last):
        if labels[j] >= 0:
            for k in range(indptr[j], indptr[j + 1]):
                shown[labels[j] * views + view[region[k]]] += weight[k]
