"""The tree of regions: what other views keep together is a node, and without its wholes it falls into parts.

Regions of all levels and views are compared by what contains them (`liftcore.solve.objects`): a **container** of
region m is the region of a level that has CONTAINS of what the level holds of m, where it holds OBSERVES of m at
least. View v observes a pair of regions where it sees both, and supports it where a region of any of its levels
contains both, so that masks of a whole thing hold its parts together. Then::

    rate(A, B) = (sum of supporting views) / (sum of observing views)      over pairs of a region of A with one of B

and the two clusters of the highest rate become one, down to a rate of TOGETHER. That is average linkage in which a
pair counts as often as it was observed: opposite sides of a wall, which no view sees together, neither join nor part.
A rate of two clusters with a third lies between their own, so that neighbour chains find the same tree as a search
among all pairs does (Murtagh 1983). Compare MaskClustering (Yan et al., CVPR 2024), whose consensus rate this is.

A cluster with regions of LEAST_VIEWS views is a root. Regions that **span** it, with SPANS of the cluster's regions
that their level sees, are masks of the whole. Without them the rest is clustered again, and a view that has but masks
of the whole observes nothing there. A mask that reaches out of the whole and does not span it says what belongs
together like any other: a handle that is merged with the wall behind it is still one handle. What is held together
then is a part, where LEAST_SHOWN of the views that see it show it apart: mistakes cut a thing, too, but each view
elsewhere. Parts have parts likewise, however many levels there are and whatever they are called. No feature is read.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from liftcore.runtime.jit import kernel
from liftcore.solve.membership import RegionGroups
from liftcore.values.region_weights import run_each

NO_NODE = -1
SPLIT, UNSEEN = -1, -2  # in place of a container: the level sees the region in several of its own, or hardly at all
TOGETHER = 0.5  # of the views that see two regions: most of them
LEAST_VIEWS = 3  # with a region of a node: two may make the same mistake
SPANS = 0.8  # of the regions of a node that a level sees: more, and a region is a mask of the whole node
MOST_DEPTH = 32  # of the tree
LEAST_SHOWN = 0.25  # of the views that see a part, which show it apart; of random cuts a fifth do at most


@dataclass(frozen=True)
class RegionTree:
    """Nodes of regions; a node comes before its parts."""

    region: np.ndarray  # [M] i32, the smallest node that each region is of; -1 for none
    parents: np.ndarray  # [N] i32, of each node; -1 of a root
    confidence: np.ndarray  # [N] f32 in 0..1, of the views that see a node those that have a mask of the whole

    def lineage(self) -> csr_array:
        """[N, N] i8: one where the node of a column is that of the row or holds it."""
        size = self.parents.size
        ones, above = [np.arange(size)], [np.arange(size)]
        while ones[-1].size:
            parent = self.parents[above[-1]]
            ones.append(ones[-1][parent >= 0])
            above.append(parent[parent >= 0])
        rows, columns = np.concatenate(ones), np.concatenate(above)
        return csr_array((np.ones(rows.size, np.int8), (rows, columns)), shape=(size, size))


def node_groups(nodes: np.ndarray, groups: RegionGroups) -> tuple[np.ndarray, np.ndarray, int]:
    """The view of each node among those of nodes, [N] i64, its group among theirs [N] i32, and how many views."""
    view = groups.view[nodes]
    number = np.unique(view, return_inverse=True)[1]
    level = groups.group[nodes] - view * groups.levels
    return number, (number * groups.levels + level).astype(np.int32), int(number.max(initial=-1)) + 1


def region_tree(
    nodes: np.ndarray, groups: RegionGroups, containers: np.ndarray, threads: int | None = None
) -> RegionTree:
    """The tree of some regions.

    Args:
        nodes: [n] i64, regions, ascending. containers: [n, views * levels] i32, places in ``nodes``, SPLIT or UNSEEN.
        threads: None takes the cores that this process may use. The result is bitwise identical for any value.
    """
    view, group, views = node_groups(nodes, groups)
    node = np.full(nodes.size, NO_NODE, np.int32)
    parents, confidence = list[int](), list[float]()
    waiting = deque([(np.arange(nodes.size), NO_NODE, 0, np.zeros(nodes.size, np.bool_))] if nodes.size else [])
    while waiting:
        own, parent, depth, above = waiting.popleft()
        labels = _clusters(_without(containers[own], above), groups.levels, threads)
        for part in np.split(own[np.argsort(labels, kind="stable")], np.cumsum(np.bincount(labels))[:-1]):
            shown, seen = np.unique(view[part]).size, _seen_by(containers[part], groups.levels)
            if shown < min(LEAST_VIEWS, views) or (parent != NO_NODE and shown < LEAST_SHOWN * seen):
                continue
            spanning = _spanning(part, containers, group)
            whole = spanning[part]
            node[part] = len(parents)
            if whole.any() and not whole.all() and depth + 1 < MOST_DEPTH:
                waiting.append((part[~whole], len(parents), depth + 1, above | spanning))
            parents.append(parent)
            confidence.append(min(np.unique(view[part[whole]]).size / max(seen, 1), 1.0))
    region = np.full(groups.view.size, NO_NODE, np.int32)
    region[nodes] = node
    return RegionTree(region, np.array(parents, np.int32), np.array(confidence, np.float32))


def _without(containers: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Containers [n, views * levels] without masks of wholes [N] bool, whose levels then see nothing of the nodes."""
    return np.where((containers >= 0) & above[np.maximum(containers, 0)], UNSEEN, containers)


def _seen_by(containers: np.ndarray, levels: int) -> int:
    """How many views see half of some nodes or more."""
    seen = (containers.reshape(len(containers), -1, levels) != UNSEEN).any(axis=2)
    return int((2 * seen.sum(axis=0) >= len(containers)).sum())


def _spanning(part: np.ndarray, containers: np.ndarray, group: np.ndarray) -> np.ndarray:
    """[N] bool: the nodes, of all, that contain SPANS of those of a cluster's nodes [n] that their level sees."""
    there = containers[part]
    held = np.bincount(there[there >= 0], minlength=len(containers))
    return (held > 0) & (held >= SPANS * (there != UNSEEN).sum(axis=0)[group])


def _clusters(containers: np.ndarray, levels: int, threads: int | None) -> np.ndarray:
    """[n] i64, the cluster of each node, from 0 in the order of their first nodes.

    Args:
        containers: [n, views * levels] i32, of these nodes, among all.
    """
    size = len(containers)
    at, column = np.nonzero(containers >= 0)
    shape = size, int(containers.max(initial=0)) + 1
    held = csr_array((np.ones(at.size, np.int8), (at, containers[at, column])), shape=shape).tocsc()
    held.sort_indices()
    supporting = np.zeros((size, size), np.float32)
    blocks = [(first, min(first + 64, size)) for first in range(0, size, 64)]
    run_each(lambda a, b: support(a, b, containers, levels, held.indptr, held.indices, supporting), blocks, threads)
    sees = (containers.reshape(size, -1, levels) != UNSEEN).any(axis=2).astype(np.float32)
    return clustered(supporting, sees @ sees.T)


def clustered(supporting: np.ndarray, observing: np.ndarray) -> np.ndarray:
    """[N] i64, the cluster of each node, from 0 in the order of their first nodes.

    Args:
        supporting, observing: [N, N] f32, how many views, symmetric; both are overwritten.
    """
    from scipy.sparse.csgraph import connected_components

    size = supporting.shape[0]
    pairs, rates = np.zeros((max(size - 1, 0), 2), np.int64), np.zeros(max(size - 1, 0))
    neighbour_chain(supporting, observing, pairs, rates)
    # Of nodes that stand for clusters: those of a merge that counts were merged at higher rates before.
    one, other = pairs[rates >= TOGETHER].T
    merged = csr_array((np.ones(one.size, np.int8), (one, other)), shape=(size, size))
    return connected_components(merged, directed=False)[1]


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
