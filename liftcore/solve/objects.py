"""Objects without words: regions that other views keep together are one thing. No feature is read.

Regions are nodes of a graph; `liftcore.solve.region_tree` says which of them are one thing, and which its parts. Here
it gets what it reads, the containers of each node: with R as mask consensus has it (`liftcore.solve.consensus`),
splats counting by ``sqrt(t_j)``, a level of a view **sees** region m where it holds at least OBSERVES of it, and its
region n **contains** m where n has CONTAINS of what the level holds.

A splat belongs to a **path** of nodes: to the root whose regions, with those of its parts, weigh most at it, if these
have half of all roots' weight there; then to the part of it that weighs most, if this has half of all parts' weight
and of what the levels that show the part have there; and so on. A part that has SAME_SPLATS of its whole's splats is
that whole, seen twice. **Objects** are the roots, numbered by total weight, the largest first; of a root that holds
MOST_OF_SCENE of the splats, its parts are. Other nodes are numbered after them.

Memory and time are bounded: nodes are the regions of evenly chosen views, MOST_REGIONS at most, with two tables of
that square (134 MB); regions of other views then join the smallest node that has most of them. Counts are whole
numbers and sums have the order of splats, so that the number of threads changes no bit.

**How it splits.** What contains a node is a function of MOST_SPLATS of its splats and of the nodes that these belong
to, so blocks of views find it for their own nodes (`node_containers`). The tree is the driver's. The path of a splat
is a function of its row of W (`node_labels`); the nodes of the other regions and the best views are sums over splats,
taken by pieces (`node_shares`, `view_shares`).
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array

from liftcore.runtime.jit import kernel
from liftcore.solve.codebook import Codebook
from liftcore.solve.consensus import SplatTuples
from liftcore.solve.membership import Memberships, RegionGroups, memberships
from liftcore.solve.region_tree import NO_NODE, SPLIT, UNSEEN, RegionTree, node_groups, region_tree
from liftcore.solve.sums import PieceSums, added, in_order, piece_sums, pieces
from liftcore.values.region_weights import RegionWeights, row_blocks, run_each

CPU = torch.device("cpu")
OBSERVES = 0.3  # of a region, that a level must see to say anything of it, as for mask consensus
CONTAINS = 0.7  # of what a level sees of a region: less, and the region lies across two others
SAME_SPLATS = 0.9  # of a whole, from which a part is that whole
MOST_OF_SCENE = 0.8  # of its splats: what holds more sets nothing apart
SAY_THE_SAME = 0.8  # cosine of parts and wholes: of masks that are named alike it is .95 and more
MOST_REGIONS = 1 << 12
FEWEST_VIEWS = 16  # that give nodes, where there are so many, however many regions they have
MOST_SPLATS = 1 << 11  # of a region, evenly chosen: a share needs no more
BEST_VIEWS = 5  # that are kept of each node
BLOCK_ENTRIES = 1 << 18


@dataclass(frozen=True)
class NodeSplats:
    """The splats of some nodes, and the nodes, of all, that each of these splats belongs to."""

    begins: np.ndarray  # [n + 1], where the splats of each node begin
    splats: np.ndarray  # i32, ascending in a node
    starts: np.ndarray  # [s + 1], where the nodes of each splat begin
    members: np.ndarray  # u16 (fewer bytes to read), numbers of nodes, ascending in a splat
    counts: np.ndarray  # [s] f64, how much each splat counts: sqrt(t_j)


@dataclass(frozen=True)
class RegionObjects:
    """What the graph of regions holds together: N nodes, of which the first K are objects."""

    labels: np.ndarray  # [P] i32, the object of each splat; -1 for none
    node: np.ndarray  # [P] i32, the smallest node of each splat; -1 for none
    tree: RegionTree  # of all views; its nodes in no order but that the first are objects
    node_views: np.ndarray  # [N, BEST_VIEWS] i32, that show most of each, best first; -1 after the last
    count: int  # K

    @property
    def views(self) -> np.ndarray:
        """[K, BEST_VIEWS] i32, those of objects."""
        return self.node_views[: self.count]


@dataclass(frozen=True)
class NodeNumbers:
    """What the nodes of a tree are, once it is known which splats they hold: [N + 1] i32 each, the last -1."""

    node: np.ndarray  # its number, that of its whole where it is the same thing; -1: no splat is of it
    object: np.ndarray  # the object that it is or is of; -1 for none
    count: int  # objects


def region_objects(
    W: RegionWeights,
    levels: np.ndarray,
    total_weight: np.ndarray,
    threads: int | None = None,
    *,
    members: Memberships | None = None,
) -> RegionObjects:
    """The objects of a scene whose W lies in one place, with their parts.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        total_weight: [P], sums of plain weights; objects are numbered by it.
        threads: None takes the cores that this process may use. The number changes no bit.
        members: of W, where they are known.
    """
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    members = members or memberships(W, groups, threads)
    sizes = np.zeros(levels.size, np.int64)
    count_members(W.region.numpy(), members.own, sizes)
    nodes, others = choose_nodes(groups, sizes)
    table = node_splats(W, members, nodes, threads)
    tree = region_tree(nodes, groups, node_containers(table, nodes, groups, threads), threads)
    number = tree.parents.size
    labels = node_labels(W, groups, tree, threads)
    if number and others.size:
        tree = with_others(tree, others, node_shares(W, labels, number, others, threads))
        labels = node_labels(W, groups, tree, threads)
    shown = added(view_shares(W, groups, labels, number, threads), (1, number * groups.views))
    return numbered(labels, tree, node_numbering(labels, total_weight, tree), shown.reshape(number, groups.views))


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
    found = np.empty(starts[-1], np.uint16)
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
    members = np.empty(starts[-1], np.uint16)
    list_tuple_nodes(*[*parts, starts, members])
    return NodeSplats(begins, splats.astype(np.int32), starts, members, np.sqrt(totals))


def by_node(starts: np.ndarray, members: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the splats of each node begin, and these splats, from the nodes of each splat."""
    ones = np.ones(members.size, np.int8)
    table = csr_array((ones, members, starts), shape=(starts.size - 1, nodes)).tocsc()
    return table.indptr, table.indices


def node_containers(
    table: NodeSplats, nodes: np.ndarray, groups: RegionGroups, threads: int | None = None
) -> np.ndarray:
    """[n, views * levels] i32: of the nodes of a table, the node of each level that contains it, SPLIT or UNSEEN.

    Args:
        nodes: [N] i64, all of them, as the table's members number them.
    """
    _, group, views = node_groups(nodes, groups)
    size = table.begins.size - 1
    found = np.full((size, groups.levels * views), UNSEEN, np.int32)
    arrays = table.begins, table.splats, table.starts, table.members, table.counts
    run_each(
        lambda a, b: contain(a, b, *arrays, group, found),
        row_blocks(np.diff(table.begins), max(size, 1), BLOCK_ENTRIES >> 3) if nodes.size else [],
        threads,
    )
    return found


def node_labels(W: RegionWeights, groups: RegionGroups, tree: RegionTree, threads: int | None = None) -> np.ndarray:
    """[n] i32: the smallest node of each splat of a block, -1 for none.

    Args:
        W: of all views, a row for each splat of the block.
    """
    labels = np.full(W.indptr.shape[0] - 1, NO_NODE, np.int32)
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    shows = np.zeros((tree.parents.size, groups.views * groups.levels), np.bool_)
    place, node = groups.group[tree.region >= 0], tree.region[tree.region >= 0]
    while node.size:
        shows[node, place] = True
        node = tree.parents[node]
        place, node = place[node >= 0], node[node >= 0]
    run_each(
        lambda a, b: elect(a, b, indptr, region, weight, groups.group, tree.region, tree.parents, shows, labels),
        W.blocks(1 << 16, 1 << 20),
        threads,
    )
    return labels


def node_shares(
    W: RegionWeights, labels: np.ndarray, number: int, others: np.ndarray, threads: int | None = None
) -> Iterator[PieceSums]:
    """The weight of some regions [n] i64 in each label at every piece of a block: [1, (number + 1) n], -1 first."""
    place, indptr = node_numbers(others, int(W.offsets[-1])), W.indptr.numpy()
    arrays = indptr, W.region.numpy(), W.weight.numpy(), place, others.size

    def summed(first: int, last: int) -> PieceSums:
        order = np.argsort(labels[first:last], kind="stable")
        ends = np.cumsum(np.bincount(labels[first:last] + 1, minlength=number + 1))
        places, sums = sum_by_label(order + first, ends, *arrays)
        return PieceSums(places, sums[None])

    return in_order(summed, pieces(W.indptr.shape[0] - 1), threads)


def with_others(tree: RegionTree, others: np.ndarray, shares: Iterable[PieceSums]) -> RegionTree:
    """The tree with regions of views without nodes, each of the smallest node that has over half of its weight.

    Args:
        others: [n] i64, these regions. shares: theirs (`node_shares`), of all splats.
    """
    shape = tree.parents.size + 1, others.size
    table = csr_array(shape, dtype=np.float64)
    for part in shares:
        table = table + csr_array((part.values[0], np.divmod(part.places, others.size)), shape=shape)
    totals = np.asarray(table.sum(axis=0)).ravel()
    found = csr_array(tree.lineage().T.astype(np.float64) @ csr_array(table)[1:]).tocoo()
    most = found.data > totals[found.col] / 2  # nodes of one path
    region = tree.region.copy()
    np.maximum.at(region, others[found.col[most]], found.row[most])  # parts come after their wholes
    return replace(tree, region=region)


def view_shares(
    W: RegionWeights, groups: RegionGroups, labels: np.ndarray, number: int, threads: int | None = None
) -> Iterator[PieceSums]:
    """The weight of each label in each view at every piece of a block: [1, number views]."""
    arrays = labels, W.indptr.numpy(), W.region.numpy(), W.weight.numpy(), groups.view, groups.views

    def add(first: int, last: int, table: np.ndarray) -> None:
        show(*[first, last, *arrays, table[0]])

    return piece_sums(add, labels.size, (1, number * groups.views), threads)


def node_numbering(labels: np.ndarray, total_weight: np.ndarray, tree: RegionTree) -> NodeNumbers:
    """Which nodes are objects, and the numbers of all.

    Args:
        labels: [P] i32, the smallest node of each splat. total_weight: [P].
    """
    number, own = tree.parents.size, labels >= 0
    above = tree.lineage().T.astype(np.float64)
    splats = above @ np.bincount(labels[own], minlength=number)
    same, parents = np.arange(number), tree.parents.copy()
    for node in range(number):
        whole = tree.parents[node]
        if whole >= 0:
            parents[node] = same[whole]
            if splats[node] >= SAME_SPLATS * splats[whole]:
                same[node] = same[whole]
    kept = (same == np.arange(number)) & (splats > 0)
    root, parts = np.full(number, NO_NODE), np.bincount(parents[kept & (parents >= 0)], minlength=number)
    for node in np.flatnonzero(kept):
        whole = parents[node]
        apart = whole < 0 or (root[whole] == NO_NODE)
        most = apart and splats[node] >= MOST_OF_SCENE * (total_weight > 0).sum() and parts[node] > 1
        root[node] = NO_NODE if most else node if apart else root[whole]
    objects = np.where(kept, root, NO_NODE)
    of_object = np.append(objects[same], NO_NODE)[labels]  # -1 is the place after the last node
    sums = np.bincount(of_object[of_object >= 0], total_weight[of_object >= 0], number)
    first = np.argsort(-sums, kind="stable")
    first = first[(objects == np.arange(number))[first]]
    whole = above @ np.bincount(labels[own], total_weight[own], number)
    later = np.argsort(-whole, kind="stable")
    order = np.concatenate([first, later[(kept & (objects != np.arange(number)))[later]]])
    place = np.full(number + 1, NO_NODE, np.int32)
    place[order] = np.arange(order.size)
    return NodeNumbers(place[np.append(same, NO_NODE)], place[np.append(objects[same], NO_NODE)], first.size)


def numbered(labels: np.ndarray, tree: RegionTree, numbers: NodeNumbers, shown: np.ndarray) -> RegionObjects:
    """The objects of a scene.

    Args:
        labels: [P] i32, the smallest node of each splat. numbers: of the tree's nodes (`node_numbering`).
        shown: [N, V] f64, the weight of each label in each view.
    """
    new = numbers.node[:-1]
    first = np.unique(new, return_index=True)[1]  # a whole comes before parts that are the same thing
    order = first[int((new < 0).any()) :]
    above = tree.parents[order]
    made = RegionTree(
        numbers.node[tree.region], np.where(above >= 0, new[above], NO_NODE).astype(np.int32), tree.confidence[order]
    )
    whole = np.asarray(tree.lineage().T.astype(np.float64) @ shown)[order]
    return RegionObjects(numbers.object[labels], numbers.node[labels], made, _best_views(whole), numbers.count)


@dataclass(frozen=True)
class NodeVectors:
    """Vectors of the masks of nodes."""

    vectors: np.ndarray  # [N, F] f32, the unit mean of the unit vectors of a node's own regions; zeros for none
    level_agreement: float | None  # cosine of parts and their wholes, about the scene's mean; None without parts

    @property
    def levels_disagree(self) -> bool:
        """True where masks of things and of their parts say different things."""
        return self.level_agreement is not None and self.level_agreement < SAY_THE_SAME

    @classmethod
    def of(cls, codebook: Codebook, totals: np.ndarray, found: RegionObjects) -> "NodeVectors":
        """Means by the weights of regions; those of a node's parts are not its own, so levels stay apart.

        The agreement is free of noise: masks of a part and of its whole are others, so the mean product of their
        vectors is that of what they mean, and of the squared length of a mean of noisy ones their own squares are
        taken away. Parts count by their splats.

        Args:
            totals: [M] f64, the weight of each region.
        """
        tree, number = found.tree, found.tree.parents.size
        own = np.flatnonzero(tree.region >= 0)
        places = tree.region[own], own
        shares, squares = (csr_array((totals[own] ** k, places), shape=(number, totals.size)) for k in (1, 2))
        parts = np.flatnonzero(tree.parents >= 0)
        wholes = tree.parents[parts]
        splats = tree.lineage().T.astype(np.float64) @ np.bincount(found.node[found.node >= 0], minlength=number)
        whole, sums = totals.sum() or 1.0, np.zeros((number, codebook.channels))
        products, power = np.zeros(parts.size), np.zeros(number)
        weights = np.maximum(shares.sum(axis=1), 1e-30)
        for channels in codebook.slices():
            unit = codebook.unit_values(channels, CPU).numpy()
            sums[:, channels] = shares @ unit
            unit = unit - (totals @ unit / whole).astype(np.float32)
            centred = shares @ unit
            products += (centred[parts] * centred[wholes]).sum(axis=1)
            power += (centred**2).sum(axis=1) - squares @ (unit**2).sum(axis=1)
        power /= np.maximum(weights**2 - squares.sum(axis=1), 1e-30)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        vectors = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0).astype(np.float32)
        scale = float(splats[parts] @ power[parts]) * float(splats[parts] @ power[wholes])
        told = float(splats[parts] @ (products / (weights[parts] * weights[wholes])))
        known = scale > 0 and min(splats[parts] @ power[parts], splats[parts] @ power[wholes]) > 0
        return cls(vectors, float(np.clip(told / math.sqrt(scale), -1, 1)) if known else None)


def object_facts(found: RegionObjects, said: NodeVectors) -> dict[str, Any]:
    """What the graph of regions held together, for the diagnostics."""
    own = np.bincount(found.node[found.node >= 0], minlength=len(found.node_views))
    held = (found.tree.lineage().T.astype(np.float64) @ own) / max(found.node.size, 1)
    facts: dict[str, Any] = {
        "found": found.count,
        "splats_share": float((found.labels >= 0).mean()),
        "regions": int((found.tree.region >= 0).sum()),
        "nodes": len(found.node_views),
        "largest_share": float(held.max(initial=0.0)),
        "level_agreement": said.level_agreement,
    }
    told = []
    if facts["largest_share"] >= MOST_OF_SCENE:
        largest = int(held.argmax())
        rest = "objects are its parts" if largest >= found.count else "no part of it was found: take finer masks"
        told.append(f"masks hold {facts['largest_share']:.0%} of the splats together as one thing; {rest}")
    if said.levels_disagree:
        told.append(
            f"masks of things and of their parts say different things (their vectors' cosine is "
            f"{said.level_agreement:.2f}), and a splat's feature is the sum of both: ask nodes of the tree, which "
            "hold them apart"
        )
    return facts | ({"warning": "; ".join(told)} if told else {})


def _best_views(shown: np.ndarray) -> np.ndarray:
    """[K, BEST_VIEWS] i32: the views in which each node weighs most."""
    best = np.full((len(shown), BEST_VIEWS), -1, np.int32)
    order = np.argsort(-shown, axis=1, kind="stable")[:, :BEST_VIEWS]
    best[:, : order.shape[1]] = np.where(np.take_along_axis(shown, order, axis=1) > 0, order, -1)
    return best


@kernel
def count_members(region, own, sizes):
    """Add the splats that belong to each region to ``sizes``."""
    for k in range(region.size):
        sizes[region[k]] += own[k]


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
def contain(first, last, begins, splats, starts, members, counts, group, container):
    """For nodes ``first..last``: the node of each group that contains it, or that it is split there, or unseen."""
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
                container[m, g] = largest[g] if most[g] >= CONTAINS * seen[g] else SPLIT
        for i in range(found):
            n = met[i]
            R[n], seen[group[n]], most[group[n]] = 0.0, 0.0, 0.0


@kernel
def elect(first, last, indptr, region, weight, group, node, parents, shows, labels):
    """For splats ``first..last``: the smallest node of their path; ``shows`` [N, groups] says what levels show."""
    sums, totals = np.zeros(parents.size), np.zeros(shows.shape[1])
    met, groups = np.empty(parents.size, np.int32), np.empty(shows.shape[1], np.int32)
    for j in range(first, last):
        found, levels = 0, 0
        for k in range(indptr[j], indptr[j + 1]):
            g, n = group[region[k]], node[region[k]]
            if g >= 0:
                if totals[g] == 0.0:
                    groups[levels] = g
                    levels += 1
                totals[g] += weight[k]
            while n >= 0:
                if sums[n] == 0.0:
                    met[found] = n
                    found += 1
                sums[n] += weight[k]
                n = parents[n]
        best = heaviest_part(-1, met[:found], sums, parents)
        while best >= 0:
            labels[j] = best
            best = heaviest_part(best, met[:found], sums, parents)
            if best >= 0 and 2.0 * sums[best] < shown_weight(best, groups[:levels], totals, shows):
                best = -1
        sums[met[:found]] = 0.0
        totals[groups[:levels]] = 0.0


@kernel
def heaviest_part(whole, met, sums, parents):
    """The part of a node that weighs most, where it has half of what all parts weigh; -1 for none."""
    best, every = -1, 0.0
    for n in met:
        if parents[n] == whole:
            every += sums[n]
            if best < 0 or sums[n] > sums[best]:
                best = n
    return best if best >= 0 and 2.0 * sums[best] >= every else -1


@kernel
def shown_weight(node, groups, totals, shows):
    """What the levels that show a node weigh at a splat."""
    seen = 0.0
    for g in groups:
        if shows[node, g]:
            seen += totals[g]
    return seen


@kernel
def show(first, last, labels, indptr, region, weight, view, views, shown):
    """Add the weight [N V] that each label has in each view, of splats ``first..last``."""
    for j in range(first, last):
        if labels[j] >= 0:
            for k in range(indptr[j], indptr[j + 1]):
                shown[labels[j] * views + view[region[k]]] += weight[k]


@kernel
def sum_by_label(rows, ends, indptr, region, weight, place, size):
    """The weight of the regions with a place at the rows of each label: (label size + place, weight), ascending.

    Args:
        rows: [n] i64, those of the first label before those of the second. ends: [labels] i64, of each label.
        place: [M] i32 below size; -1 for none.
    """
    places, values, count = np.empty(1 << 10, np.int64), np.empty(1 << 10), 0
    sums, is_met, met = np.zeros(size), np.zeros(size, np.bool_), np.empty(size, np.int32)
    begin = 0
    for label in range(ends.size):
        found = 0
        for row in rows[begin : ends[label]]:
            for k in range(indptr[row], indptr[row + 1]):
                at = place[region[k]]
                if at >= 0:
                    if not is_met[at]:
                        is_met[at] = True
                        met[found] = at
                        found += 1
                    sums[at] += weight[k]
        while count + found > places.size:
            places, values = np.concatenate((places, places)), np.concatenate((values, values))
        for at in np.sort(met[:found]):
            places[count], values[count] = label * size + at, sums[at]
            count += 1
            sums[at], is_met[at] = 0.0, False
        begin = ends[label]
    return places[:count].copy(), values[:count].copy()
