"""The tree of regions: regions that other views group together are a node, which splits into parts without its
wholes.

Regions of all levels and views are compared by their containers (`liftcore.solve.objects`): the **container** of
region m in a level is the region with CONTAINS of the level's share of m, if the level has at least OBSERVES of m.
View v observes a pair of regions if it sees both, and supports the pair if a region of any of its levels contains
both, so masks of a whole object group its parts. Then::

    rate(A, B) = (sum of supporting views) / (sum of observing views)      over pairs of a region of A with one of B

and the two clusters with the highest rate are merged, down to a rate of MERGE_RATE. This is average linkage weighted
by observations: opposite sides of a wall, which no view sees together, are neither merged nor separated. The rate of
a merged cluster with a third lies between the rates of its two, so neighbour chains find the same tree as a search
over all pairs (Murtagh 1983). The rate is the consensus rate of MaskClustering (Yan et al., CVPR 2024).

A cluster with regions of LEAST_VIEWS views is a root. Regions that **span** it, which contain SPANS of the cluster's
regions that their level sees, are masks of the whole. Without them the rest is clustered again, and a view that has
only masks of the whole observes nothing there. A mask that extends beyond the whole and does not span it counts as
any
other: a handle that is merged with the wall behind it is still one handle. A cluster is then a part if LEAST_SHOWN of
the views that see it separate it: mistakes split an object too, but differently in each view. Parts have parts
likewise, for any number and names of levels. Features are not used.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from liftcore.runtime.jit import kernel
from liftcore.solve.consensus import RegionGroups
from liftcore.values.region_weights import run_each

NO_NODE = -1
SPLIT, UNSEEN = -1, -2  # instead of a container: the level splits the region, or hardly sees it
MERGE_RATE = 0.5  # of the views that see two regions: the majority
LEAST_VIEWS = 3  # with a region of a node, as two views may make the same mistake
SPANS = 0.8  # of a node's regions that a level sees: a region that contains more is a mask of the whole node
MOST_DEPTH = 32  # of the tree
LEAST_SHOWN = 0.25  # of the views that see a part, to separate it; at most a fifth do for random splits


@dataclass(frozen=True)
class RegionTree:
    """A forest of nodes of regions; a node comes before its parts."""

    region: np.ndarray  # [M] i32, the smallest node of each region; -1 for none
    parents: np.ndarray  # [N] i32, of each node; -1 for a root
    confidence: np.ndarray  # [N] f32 in 0..1, share of the views that see a node which have a mask of the whole

    def lineage(self) -> csr_array:
        """Return the matrix [N, N] i8 with ones where the column's node is the row's node or an ancestor of it."""
        size = self.parents.size
        ones, above = [np.arange(size)], [np.arange(size)]
        while ones[-1].size:
            parent = self.parents[above[-1]]
            ones.append(ones[-1][parent >= 0])
            above.append(parent[parent >= 0])
        rows, columns = np.concatenate(ones), np.concatenate(above)
        return csr_array((np.ones(rows.size, np.int8), (rows, columns)), shape=(size, size))


def node_groups(nodes: np.ndarray, groups: RegionGroups) -> tuple[np.ndarray, np.ndarray, int]:
    """Renumber views and groups over those with nodes: return view [N] i64 and group [N] i32 of each node, and V."""
    view = groups.view[nodes]
    number = np.unique(view, return_inverse=True)[1]
    level = groups.group[nodes] - view * groups.levels
    return number, (number * groups.levels + level).astype(np.int32), int(number.max(initial=-1)) + 1


def region_tree(
    nodes: np.ndarray, groups: RegionGroups, containers: np.ndarray, threads: int | None = None
) -> RegionTree:
    """Build the tree of some regions.

    Args:
        nodes: [n] i64, regions, ascending. containers: [n, views * levels] i32, indices in ``nodes``, SPLIT or
            UNSEEN.
    """
    view, group, views = node_groups(nodes, groups)
    node = np.full(nodes.size, NO_NODE, np.int32)
    parents, confidence = list[int](), list[float]()
    waiting = deque([(np.arange(nodes.size), NO_NODE, 0, np.zeros(nodes.size, np.bool_))] if nodes.size else [])
    while waiting:
        cluster, parent, depth, above = waiting.popleft()
        labels = _clusters(_without(containers[cluster], above), groups.levels, threads)
        for part in np.split(cluster[np.argsort(labels, kind="stable")], np.cumsum(np.bincount(labels))[:-1]):
            view_count, observers = np.unique(view[part]).size, _count_observers(containers[part], groups.levels)
            if view_count < min(LEAST_VIEWS, views) or (parent != NO_NODE and view_count < LEAST_SHOWN * observers):
                continue
            spanning = _spanning(part, containers, group)
            is_whole = spanning[part]
            node[part] = len(parents)
            if is_whole.any() and not is_whole.all() and depth + 1 < MOST_DEPTH:
                waiting.append((part[~is_whole], len(parents), depth + 1, above | spanning))
            parents.append(parent)
            confidence.append(min(np.unique(view[part[is_whole]]).size / max(observers, 1), 1.0))
    region = np.full(groups.view.size, NO_NODE, np.int32)
    region[nodes] = node
    return RegionTree(region, np.array(parents, np.int32), np.array(confidence, np.float32))


def _without(containers: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return containers [n, views * levels] without masks of wholes [N] bool; their levels become UNSEEN."""
    return np.where((containers >= 0) & above[np.maximum(containers, 0)], UNSEEN, containers)


def _count_observers(containers: np.ndarray, levels: int) -> int:
    """Count the views that see at least half of some nodes."""
    visible = (containers.reshape(len(containers), -1, levels) != UNSEEN).any(axis=2)
    return int((2 * visible.sum(axis=0) >= len(containers)).sum())


def _spanning(part: np.ndarray, containers: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return a mask [N] bool of the nodes that contain SPANS of a cluster's nodes [n] that their level sees."""
    part_containers = containers[part]
    counts = np.bincount(part_containers[part_containers >= 0], minlength=len(containers))
    return (counts > 0) & (counts >= SPANS * (part_containers != UNSEEN).sum(axis=0)[group])


def _clusters(containers: np.ndarray, levels: int, threads: int | None) -> np.ndarray:
    """Return the cluster of each node, [n] i64, from 0 in the order of their first nodes.

    Args:
        containers: [n, views * levels] i32, of these nodes, numbered among all.
    """
    size = len(containers)
    at, column = np.nonzero(containers >= 0)
    shape = size, int(containers.max(initial=0)) + 1
    node_members = csr_array((np.ones(at.size, np.int8), (at, containers[at, column])), shape=shape).tocsc()
    node_members.sort_indices()
    supporting = np.zeros((size, size), np.float32)
    blocks = [(first, min(first + 64, size)) for first in range(0, size, 64)]
    run_each(
        lambda a, b: count_supporting_views(
            a, b, containers, levels, node_members.indptr, node_members.indices, supporting
        ),
        blocks,
        threads,
    )
    sees = (containers.reshape(size, -1, levels) != UNSEEN).any(axis=2).astype(np.float32)
    return cluster_nodes(supporting, sees @ sees.T)


def cluster_nodes(supporting: np.ndarray, observing: np.ndarray) -> np.ndarray:
    """Return the cluster of each node, [N] i64, from 0 in the order of their first nodes.

    Args:
        supporting, observing: [N, N] f32, numbers of views, symmetric; both are overwritten.
    """
    from scipy.sparse.csgraph import connected_components

    size = supporting.shape[0]
    pairs, rates = np.zeros((max(size - 1, 0), 2), np.int64), np.zeros(max(size - 1, 0))
    neighbour_chain(supporting, observing, pairs, rates)
    # Pairs of nodes that represent clusters, which were merged before at higher rates.
    first, second = pairs[rates >= MERGE_RATE].T
    merged = csr_array((np.ones(first.size, np.int8), (first, second)), shape=(size, size))
    return connected_components(merged, directed=False)[1]


@kernel
def count_supporting_views(first, last, container, several, begins, node_members, supporting):
    """Count for nodes ``first..last`` the views with a region of any level that contains both it and another node."""
    last_view = np.full(container.shape[0], -1, np.int32)
    for m in range(first, last):
        last_view[:] = -1
        for g in range(container.shape[1]):
            c = container[m, g]
            if c >= 0:
                v = g // several
                for k in range(begins[c], begins[c + 1]):
                    n = node_members[k]
                    if last_view[n] != v:
                        last_view[n] = v
                        supporting[m, n] += 1.0


@kernel
def neighbour_chain(supporting, observing, pairs, rates):
    """Merge all nodes, each time two mutual nearest neighbours; a cluster keeps the row of its first node."""
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
                    candidate_rate = supporting[a, n] / observing[a, n] if observing[a, n] > 0 else 0.0
                    if candidate_rate > rate:
                        best, rate = n, candidate_rate
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
