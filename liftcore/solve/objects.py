"""Class-agnostic objects: regions that other views group together form one object. Features are not used.

Regions are nodes of a graph; `liftcore.solve.region_tree` clusters them into objects and parts. This module computes
its input, the containers of each node: with R of mask consensus (`liftcore.solve.consensus`) and splats weighted by
``sqrt(t_j)``, a level of a view **observes** region m if it has at least OBSERVES of it, and its region n
**contains** m if n has CONTAINS of the level's share of m.

A splat is assigned to a **path** of nodes: to the root whose regions, with those of its parts, have the most weight
at the splat, if that is half of the weight of all roots there; then to its heaviest part, if that has half of the
weight of all parts and of the levels that show the part; and so on. A part with SAME_SPLATS of its whole's splats is
merged into the whole. **Objects** are the roots, numbered by total weight, the largest first; a root with
MOST_OF_SCENE of the splats is replaced by its parts. Other nodes are numbered after the objects.

Memory and time are bounded: nodes are the regions of evenly chosen views, MOST_REGIONS at most, with two tables of
that square (134 MB); regions of other views then join the smallest node with over half of their weight. Counts are
integers and sums are in the order of splats, so the result is bitwise identical for any number of threads.

**Blocks of views and splats.** The containers of a node depend on MOST_SPLATS of its splats and on the nodes of these
splats, so blocks of views compute them for their own nodes (`node_containers`). The driver builds the tree. The path
of a splat is a function of its row of W (`node_labels`); the nodes of the other regions and the best views are sums
over splats, by pieces (`node_shares`, `view_shares`).
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from liftcore.runtime.jit import kernel
from liftcore.solve.codebook import Codebook
from liftcore.solve.consensus import RegionGroups, SplatTuples
from liftcore.solve.region_tree import NO_NODE, SPLIT, UNSEEN, RegionTree, node_groups
from liftcore.solve.sums import PieceSums, in_order, piece_sums, pieces
from liftcore.values.region_weights import RegionWeights, row_blocks, run_each

OBSERVES = 0.3  # share of a region that a level must see to observe it, as for mask consensus
CONTAINS = 0.7  # of the visible share of a region; with less, the region lies across two others
SAME_SPLATS = 0.9  # share of a whole's splats from which a part is that whole
MOST_OF_SCENE = 0.8  # share of all splats; a larger root separates nothing
SEPARATE_BELOW = 0.8  # cosine of parts and wholes; .95 and more for masks with the same name
MOST_REGIONS = 1 << 12
FEWEST_VIEWS = 16  # that provide nodes, if there are as many, for any number of regions
MOST_SPLATS = 1 << 11  # of a region, evenly chosen, which estimate its shares
BEST_VIEWS = 5  # stored for each node
BLOCK_ENTRIES = 1 << 18


@dataclass(frozen=True)
class RegionObjects:
    """Objects and parts of a scene: N nodes, of which the first K are objects."""

    labels: np.ndarray  # [P] i32, the object of each splat; -1 for none
    node: np.ndarray  # [P] i32, the smallest node of each splat; -1 for none
    tree: RegionTree  # of all views; its first K nodes are objects
    node_views: np.ndarray  # [N, BEST_VIEWS] i32, views with the most weight of each node, best first; -1 for none
    count: int  # K

    @property
    def views(self) -> np.ndarray:
        """The best views of objects, [K, BEST_VIEWS] i32."""
        return self.node_views[: self.count]


def choose_nodes(groups: RegionGroups, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose the regions of evenly spaced views as nodes; of more than MOST_REGIONS those with the most splats.

    Args:
        sizes: [M], the number of splats of each region.

    Returns:
        The nodes, [N] i64 ascending, and the masks of views without nodes, [n] i64 ascending.
    """
    masks = np.bincount(groups.view[groups.group >= 0], minlength=groups.views)
    showing = np.flatnonzero(masks)
    stride = max(min(-(-int(masks.sum()) // MOST_REGIONS), showing.size // FEWEST_VIEWS), 1)
    while stride * FEWEST_VIEWS < showing.size and masks[showing[::stride]].sum() > MOST_REGIONS:
        stride += 1
    candidates = np.isin(groups.view, showing[::stride]) & (groups.group >= 0)
    sizes = np.where(candidates, sizes, 0)
    nodes = np.sort(np.argsort(-sizes, kind="stable")[: min(MOST_REGIONS, int((sizes > 0).sum()))])
    has_nodes = np.isin(groups.view, groups.view[nodes])
    return nodes, np.flatnonzero((groups.group >= 0) & ~has_nodes)


def node_numbers(nodes: np.ndarray, regions: int) -> np.ndarray:
    """Return the number of each region among the nodes, [M] i32; -1 for none."""
    number = np.full(regions, -1, np.int32)
    number[nodes] = np.arange(nodes.size)
    return number


def sample_splats(
    W: RegionWeights, own_region: np.ndarray, sizes: np.ndarray, nodes: np.ndarray, base: int
) -> tuple[np.ndarray, np.ndarray]:
    """Choose MOST_SPLATS evenly spaced splats at most of each node of some views.

    Args:
        W, own_region: as `memberships` has them, of the regions ``base..base + offsets[-1]``.
        sizes: [offsets[-1]] i64, the number of splats of each of these regions. nodes: [N] i64, of all views.

    Returns:
        The offsets [n + 1] i64 of the nodes of these views, and rows of W i64, ascending in a node.
    """
    view_nodes = nodes[slice(*np.searchsorted(nodes, [base, base + sizes.size]))] - base
    steps = np.maximum(-(-sizes[view_nodes] // MOST_SPLATS), 1)
    begins = np.concatenate([[0], np.cumsum(-(-sizes[view_nodes] // steps))])
    rows, number = np.empty(begins[-1], np.int64), node_numbers(view_nodes, sizes.size)
    list_spaced(W.indptr.numpy(), W.region.numpy(), own_region, base, number, steps, begins[:-1].copy(), rows)
    return begins, rows


def node_containers(
    begins: np.ndarray,
    splats: np.ndarray,
    tuples: SplatTuples,
    totals: np.ndarray,
    nodes: np.ndarray,
    groups: RegionGroups,
    threads: int | None = None,
) -> np.ndarray:
    """Return for each node of some views and each level the node that contains it, SPLIT or UNSEEN.

    Args:
        begins: [n + 1], offsets of each node's sampled splats. splats: their numbers among the tuples and totals,
            ascending in a node.
        tuples: of these splats in all views. totals: [s] f64, t_j. nodes: [N] i64, all nodes.

    Returns:
        [n, views * levels] i32.
    """
    number, starts = node_numbers(nodes, groups.view.size), np.zeros(tuples.starts.size, np.int64)
    parts = tuples.starts, tuples.tuples, tuples.parents, tuples.members, number
    count_tuple_nodes(*[*parts, starts])
    np.cumsum(starts, out=starts)
    members = np.empty(starts[-1], np.uint16)  # fewer bytes to read
    list_tuple_nodes(*[*parts, starts, members])
    _, group, views = node_groups(nodes, groups)
    size = begins.size - 1
    containers = np.full((size, groups.levels * views), UNSEEN, np.int32)
    arrays = begins, splats.astype(np.int32), starts, members, np.sqrt(totals), group, containers
    run_each(
        lambda a, b: containing_nodes(a, b, *arrays),
        row_blocks(np.diff(begins), max(size, 1), BLOCK_ENTRIES >> 3) if nodes.size else [],
        threads,
    )
    return containers


def node_labels(W: RegionWeights, groups: RegionGroups, tree: RegionTree, threads: int | None = None) -> np.ndarray:
    """Return the smallest node of each splat of a block, [n] i32; -1 for none.

    Args:
        W: of all views, a row for each splat of the block.
    """
    labels = np.full(W.indptr.shape[0] - 1, NO_NODE, np.int32)
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    shows = nodes_by_level(tree, groups)
    run_each(
        lambda a, b: assign_splats(
            a, b, indptr, region, weight, groups.group, tree.region, tree.parents, shows, labels
        ),
        W.blocks(1 << 16, 1 << 20),
        threads,
    )
    return labels


def nodes_by_level(tree: RegionTree, groups: RegionGroups) -> np.ndarray:
    """Return the mask [N, views * levels] bool of the levels that show each node or a part of it."""
    shows = np.zeros((tree.parents.size, groups.views * groups.levels), np.bool_)
    place, node = groups.group[tree.region >= 0], tree.region[tree.region >= 0]
    while node.size:
        shows[node, place] = True
        node = tree.parents[node]
        place, node = place[node >= 0], node[node >= 0]
    return shows


def node_shares(
    W: RegionWeights, labels: np.ndarray, number: int, regions: np.ndarray, threads: int | None = None
) -> Iterator[PieceSums]:
    """Yield per piece of a block the weight of some regions [n] i64 in each label: [1, (number + 1) n], -1 first."""
    place, indptr = node_numbers(regions, int(W.offsets[-1])), W.indptr.numpy()
    arrays = indptr, W.region.numpy(), W.weight.numpy(), place, regions.size

    def sum_piece(first: int, last: int) -> PieceSums:
        order = np.argsort(labels[first:last], kind="stable")
        ends = np.cumsum(np.bincount(labels[first:last] + 1, minlength=number + 1))
        places, sums = sum_by_label(order + first, ends, *arrays)
        return PieceSums(places, sums[None])

    return in_order(sum_piece, pieces(W.indptr.shape[0] - 1), threads)


def add_regions(tree: RegionTree, regions: np.ndarray, shares: Iterable[PieceSums]) -> RegionTree:
    """Add regions of views without nodes to the tree, each to the smallest node with over half of its weight.

    Args:
        regions: [n] i64. shares: of these regions (`node_shares`), of all splats.
    """
    shape = tree.parents.size + 1, regions.size
    table = csr_array(shape, dtype=np.float64)
    for part in shares:
        table = table + csr_array((part.values[0], np.divmod(part.places, regions.size)), shape=shape)
    totals = np.asarray(table.sum(axis=0)).ravel()
    node_weights = csr_array(tree.lineage().T.astype(np.float64) @ csr_array(table)[1:]).tocoo()
    is_majority = node_weights.data > totals[node_weights.col] / 2  # nodes of one path
    region = tree.region.copy()
    # Parts come after their wholes.
    np.maximum.at(region, regions[node_weights.col[is_majority]], node_weights.row[is_majority])
    return replace(tree, region=region)


def view_shares(
    W: RegionWeights, groups: RegionGroups, labels: np.ndarray, number: int, threads: int | None = None
) -> Iterator[PieceSums]:
    """Yield per piece of a block the weight of each label in each view: [1, number views]."""
    arrays = labels, W.indptr.numpy(), W.region.numpy(), W.weight.numpy(), groups.view, groups.views

    def add(first: int, last: int, table: np.ndarray) -> None:
        accumulate_view_weight(*[first, last, *arrays, table[0]])

    return piece_sums(add, labels.size, (1, number * groups.views), threads)


def node_numbering(
    labels: np.ndarray, total_weight: np.ndarray, tree: RegionTree
) -> tuple[np.ndarray, np.ndarray, int]:
    """Number the nodes of a tree, objects first.

    Args:
        labels: [P] i32, the smallest node of each splat. total_weight: [P].

    Returns:
        The number of each node, or that of its whole if merged into it, and its object, [N + 1] i32 each, the last
        -1; -1 without splats or object. The number of objects.
    """
    number, assigned = tree.parents.size, labels >= 0
    above = tree.lineage().T.astype(np.float64)
    splats = above @ np.bincount(labels[assigned], minlength=number)
    alias, parents = np.arange(number), tree.parents.copy()
    for node in range(number):
        parent = tree.parents[node]
        if parent >= 0:
            parents[node] = alias[parent]
            if splats[node] >= SAME_SPLATS * splats[parent]:
                alias[node] = alias[parent]
    is_distinct = (alias == np.arange(number)) & (splats > 0)
    root, parts = np.full(number, NO_NODE), np.bincount(parents[is_distinct & (parents >= 0)], minlength=number)
    for node in np.flatnonzero(is_distinct):
        parent = parents[node]
        is_root = parent < 0 or (root[parent] == NO_NODE)
        is_too_large = is_root and splats[node] >= MOST_OF_SCENE * (total_weight > 0).sum() and parts[node] > 1
        root[node] = NO_NODE if is_too_large else node if is_root else root[parent]
    objects = np.where(is_distinct, root, NO_NODE)
    of_object = np.append(objects[alias], NO_NODE)[labels]  # label -1 indexes the last element, NO_NODE
    sums = np.bincount(of_object[of_object >= 0], total_weight[of_object >= 0], number)
    first = np.argsort(-sums, kind="stable")
    first = first[(objects == np.arange(number))[first]]
    node_weight = above @ np.bincount(labels[assigned], total_weight[assigned], number)
    later = np.argsort(-node_weight, kind="stable")
    order = np.concatenate([first, later[(is_distinct & (objects != np.arange(number)))[later]]])
    place = np.full(number + 1, NO_NODE, np.int32)
    place[order] = np.arange(order.size)
    return place[np.append(alias, NO_NODE)], place[np.append(objects[alias], NO_NODE)], first.size


def number_objects(
    labels: np.ndarray, total_weight: np.ndarray, tree: RegionTree, view_weights: np.ndarray
) -> RegionObjects:
    """Return the objects of a scene, with the tree in their numbering.

    Args:
        labels: [P] i32, the smallest node of each splat. total_weight: [P].
        view_weights: [N, V] f64, the weight of each label in each view.
    """
    node, of_object, count = node_numbering(labels, total_weight, tree)
    new = node[:-1]
    first = np.unique(new, return_index=True)[1]  # a whole comes before parts merged into it
    order = first[int((new < 0).any()) :]
    above = tree.parents[order]
    new_tree = RegionTree(
        node[tree.region], np.where(above >= 0, new[above], NO_NODE).astype(np.int32), tree.confidence[order]
    )
    node_weights = np.asarray(tree.lineage().T.astype(np.float64) @ view_weights)[order]
    return RegionObjects(of_object[labels], node[labels], new_tree, _best_views(node_weights), count)


@dataclass(frozen=True)
class NodeVectors:
    """Vectors of the masks of nodes."""

    vectors: np.ndarray  # [N, F] f32, the normalised mean of the unit vectors of a node's own regions; zeros for none
    level_agreement: float | None  # cosine of parts and their wholes, less the scene's mean; None without parts

    @property
    def must_separate(self) -> bool:
        """True if vectors of objects and of their parts differ so much that a lift separates the levels."""
        return self.level_agreement is not None and self.level_agreement < SEPARATE_BELOW

    @classmethod
    def of(cls, codebook: Codebook, totals: np.ndarray, objects: RegionObjects) -> "NodeVectors":
        """Compute weighted means over each node's own regions, without those of its parts, to separate levels.

        The agreement has no bias from noise: masks of a part and of its whole are different masks, so the mean
        product of their vectors is unbiased, and from the squared length of a mean of noisy vectors their own squares
        are subtracted. Parts are weighted by their splats.

        Args:
            totals: [M] f64, the weight of each region.
        """
        tree, number = objects.tree, objects.tree.parents.size
        regions = np.flatnonzero(tree.region >= 0)
        places = tree.region[regions], regions
        shares, squares = (csr_array((totals[regions] ** k, places), shape=(number, totals.size)) for k in (1, 2))
        parts = np.flatnonzero(tree.parents >= 0)
        wholes = tree.parents[parts]
        splats = tree.lineage().T.astype(np.float64) @ np.bincount(objects.node[objects.node >= 0], minlength=number)
        total, sums = totals.sum() or 1.0, np.zeros((number, codebook.channels))
        products, power = np.zeros(parts.size), np.zeros(number)
        weights = np.maximum(shares.sum(axis=1), 1e-30)
        for channels in codebook.slices():
            unit = codebook.unit_values(channels).numpy()
            sums[:, channels] = shares @ unit
            unit = unit - (totals @ unit / total).astype(np.float32)
            centred = shares @ unit
            products += (centred[parts] * centred[wholes]).sum(axis=1)
            power += (centred**2).sum(axis=1) - squares @ (unit**2).sum(axis=1)
        power /= np.maximum(weights**2 - squares.sum(axis=1), 1e-30)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        vectors = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0).astype(np.float32)
        scale = float(splats[parts] @ power[parts]) * float(splats[parts] @ power[wholes])
        covariance = float(splats[parts] @ (products / (weights[parts] * weights[wholes])))
        is_defined = scale > 0 and min(splats[parts] @ power[parts], splats[parts] @ power[wholes]) > 0
        return cls(vectors, float(np.clip(covariance / math.sqrt(scale), -1, 1)) if is_defined else None)


def object_facts(objects: RegionObjects, vectors: NodeVectors) -> dict[str, Any]:
    """Return facts and warnings about the objects, for the diagnostics."""
    splat_counts = np.bincount(objects.node[objects.node >= 0], minlength=len(objects.node_views))
    shares = (objects.tree.lineage().T.astype(np.float64) @ splat_counts) / max(objects.node.size, 1)
    facts: dict[str, Any] = {
        "found": objects.count,
        "splats_share": float((objects.labels >= 0).mean()),
        "regions": int((objects.tree.region >= 0).sum()),
        "nodes": len(objects.node_views),
        "largest_share": float(shares.max(initial=0.0)),
        "level_agreement": vectors.level_agreement,
    }
    warnings = []
    if facts["largest_share"] >= MOST_OF_SCENE:
        largest = int(shares.argmax())
        rest = "objects are its parts" if largest >= objects.count else "it has no parts: use finer masks"
        warnings.append(f"masks hold {facts['largest_share']:.0%} of the splats together as one object; {rest}")
    if vectors.must_separate:
        warnings.append(
            f"masks of objects and of their parts have different vectors (cosine "
            f"{vectors.level_agreement:.2f}), and a splat's feature is the sum of both: query nodes of the tree, "
            "which separate them"
        )
    return facts | ({"warning": "; ".join(warnings)} if warnings else {})


def _best_views(weights: np.ndarray) -> np.ndarray:
    """Return the views with the most weight of each node, [K, BEST_VIEWS] i32; -1 for none."""
    best = np.full((len(weights), BEST_VIEWS), -1, np.int32)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :BEST_VIEWS]
    best[:, : order.shape[1]] = np.where(np.take_along_axis(weights, order, axis=1) > 0, order, -1)
    return best


@kernel
def count_members(region, own_region, base, sizes):
    """Add the number of splats of each region, from ``base`` on, to ``sizes``."""
    for k in range(region.size):
        sizes[region[k] - base] += own_region[k]


@kernel
def list_spaced(indptr, region, own_region, base, number, steps, at, rows):
    """List the first, and each of ``steps`` [n] later, of the rows of each node, from ``at`` [n] on."""
    counts = np.zeros(steps.size, np.int64)
    for j in range(indptr.size - 1):
        for k in range(indptr[j], indptr[j + 1]):
            n = number[region[k] - base]
            if own_region[k] and n >= 0:
                if counts[n] % steps[n] == 0:
                    rows[at[n]] = j
                    at[n] += 1
                counts[n] += 1


@kernel
def count_tuple_nodes(begins, tuples, parents, members, number, counts):
    """Count the nodes of each splat by its tuples, at index splat + 1."""
    for j in range(begins.size - 1):
        for k in range(begins[j], begins[j + 1]):
            t = tuples[k]
            while t >= 0:
                counts[j + 1] += number[members[t]] >= 0
                t = parents[t]


@kernel
def list_tuple_nodes(begins, tuples, parents, members, number, starts, targets):
    """List the nodes of each splat, ascending from ``starts`` on: a tuple lists its regions from last to first."""
    for j in range(begins.size - 1):
        at = starts[j + 1]
        for k in range(begins[j + 1] - 1, begins[j] - 1, -1):
            t = tuples[k]
            while t >= 0:
                if number[members[t]] >= 0:
                    at -= 1
                    targets[at] = number[members[t]]
                t = parents[t]


@kernel
def containing_nodes(first, last, begins, splats, starts, members, counts, group, container):
    """Write for nodes ``first..last`` the node of each group that contains it, SPLIT or UNSEEN."""
    R, group_weights = np.zeros(group.size), np.zeros(container.shape[1])
    best_overlaps, best_nodes = np.zeros(container.shape[1]), np.zeros(container.shape[1], np.int32)
    hit_nodes = np.empty(group.size, np.int32)
    for m in range(first, last):
        count, size = 0, 0.0
        step = (begins[m + 1] - begins[m] + MOST_SPLATS - 1) // MOST_SPLATS
        for place in range(begins[m], begins[m + 1], step):
            j = splats[place]
            size += counts[j]
            for k in range(starts[j], starts[j + 1]):
                n = members[k]
                if R[n] == 0.0:
                    hit_nodes[count] = n
                    count += 1
                R[n] += counts[j]
        for i in range(count):
            n = hit_nodes[i]
            g = group[n]
            group_weights[g] += R[n]
            if R[n] > best_overlaps[g] or (R[n] == best_overlaps[g] and n < best_nodes[g]):
                best_overlaps[g], best_nodes[g] = R[n], n
        for i in range(count):
            g = group[hit_nodes[i]]
            if group_weights[g] >= OBSERVES * size:
                container[m, g] = best_nodes[g] if best_overlaps[g] >= CONTAINS * group_weights[g] else SPLIT
        for i in range(count):
            n = hit_nodes[i]
            R[n], group_weights[group[n]], best_overlaps[group[n]] = 0.0, 0.0, 0.0


@kernel
def assign_splats(first, last, indptr, region, weight, group, node, parents, shows, labels):
    """Assign splats ``first..last`` to the smallest node of their path; ``shows`` [N, groups] is True if a level has
    it.
    """
    sums, totals = np.zeros(parents.size), np.zeros(shows.shape[1])
    candidates, groups = np.empty(parents.size, np.int32), np.empty(shows.shape[1], np.int32)
    for j in range(first, last):
        count, levels = 0, 0
        for k in range(indptr[j], indptr[j + 1]):
            g, n = group[region[k]], node[region[k]]
            if g >= 0:
                if totals[g] == 0.0:
                    groups[levels] = g
                    levels += 1
                totals[g] += weight[k]
            while n >= 0:
                if sums[n] == 0.0:
                    candidates[count] = n
                    count += 1
                sums[n] += weight[k]
                n = parents[n]
        best = heaviest_part(-1, candidates[:count], sums, parents)
        while best >= 0:
            labels[j] = best
            best = heaviest_part(best, candidates[:count], sums, parents)
            if best >= 0 and 2.0 * sums[best] < shown_weight(best, groups[:levels], totals, shows):
                best = -1
        sums[candidates[:count]] = 0.0
        totals[groups[:levels]] = 0.0


@kernel
def heaviest_part(parent, candidates, sums, parents):
    """Return the heaviest part of a node, if it has half of the weight of all its parts; else -1."""
    best, total = -1, 0.0
    for n in candidates:
        if parents[n] == parent:
            total += sums[n]
            if best < 0 or sums[n] > sums[best]:
                best = n
    return best if best >= 0 and 2.0 * sums[best] >= total else -1


@kernel
def shown_weight(node, groups, totals, shows):
    """Return the weight of the levels that show a node, at a splat."""
    total = 0.0
    for g in groups:
        if shows[node, g]:
            total += totals[g]
    return total


@kernel
def accumulate_view_weight(first, last, labels, indptr, region, weight, view, views, sums):
    """Add the weights of splats ``first..last`` to the sums [N V] of their labels in each view."""
    for j in range(first, last):
        if labels[j] >= 0:
            for k in range(indptr[j], indptr[j + 1]):
                sums[labels[j] * views + view[region[k]]] += weight[k]


@kernel
def sum_by_label(rows, ends, indptr, region, weight, place, size):
    """Sum the weight of regions with a place over the rows of each label: (label size + place, weight), ascending.

    Args:
        rows: [n] i64, those of the first label before those of the second. ends: [labels] i64, of each label.
        place: [M] i32 below size; -1 for none.
    """
    places, values, count = np.empty(1 << 10, np.int64), np.empty(1 << 10), 0
    sums, is_hit, hit = np.zeros(size), np.zeros(size, np.bool_), np.empty(size, np.int32)
    begin = 0
    for label in range(ends.size):
        hit_count = 0
        for row in rows[begin : ends[label]]:
            for k in range(indptr[row], indptr[row + 1]):
                at = place[region[k]]
                if at >= 0:
                    if not is_hit[at]:
                        is_hit[at] = True
                        hit[hit_count] = at
                        hit_count += 1
                    sums[at] += weight[k]
        while count + hit_count > places.size:
            places, values = np.concatenate((places, places)), np.concatenate((values, values))
        for at in np.sort(hit[:hit_count]):
            places[count], values[count] = label * size + at, sums[at]
            count += 1
            sums[at], is_hit[at] = 0.0, False
        begin = ends[label]
    return places[:count].copy(), values[:count].copy()
