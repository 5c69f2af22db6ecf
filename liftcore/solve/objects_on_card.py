"""The inputs of `liftcore.solve.objects` from a W in a GPU's memory: the same definitions, by blocks of rows.

W stays there: the tree and its numbering receive sizes of regions, containers of nodes, labels of splats and sums.

**Containers.** Weights of splats, ``sqrt(t_j)``, are rounded to integers; the unit is 2^-49 of the largest or less.
Sums of integers do not depend on their order.

**Paths.** A block's entries are sorted by splat and by node, so that a node and its parts are neighbours at each
depth of the tree, and all splats of a block descend together. Of equally heavy parts, the one first among a splat's
entries is chosen, as on the CPU. Sums are float64 and in a fixed order: objects are bitwise reproducible on the same
GPU, and differ from those of the CPU only where a share meets its bound within rounding.

**Memory** beside W and its memberships: 2 bytes for each entry whose splat belongs to a node, 24 for each splat, and
about 0.5 GB for BLOCK_ENTRIES entries or the chosen splats of MOST_REGIONS nodes at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.membership import RegionGroups
from liftcore.solve.membership_on_card import BLOCK_ENTRIES, BLOCK_ROWS, MembershipsOnCard
from liftcore.solve.objects import CONTAINS, MOST_SPLATS, OBSERVES, node_numbers, nodes_by_level
from liftcore.solve.region_tree import NO_NODE, SPLIT, UNSEEN, RegionTree, node_groups
from liftcore.solve.sums import PieceSums
from liftcore.solve.sums_on_card import integer_weights, run_starts, sums_by_number
from liftcore.values.region_weights import RegionWeights, from_zero, row_blocks, row_entries, segment_sums

TABLE_ENTRIES = 1 << 22  # of a table of nodes by nodes


@dataclass(frozen=True)
class _NodeTable:
    """The nodes of each splat, and the evenly chosen splats of each node that estimate its shares."""

    starts: Tensor  # [P + 1] i64, offsets of each splat's nodes
    members: Tensor  # i16, numbers of nodes
    begins: Tensor  # [N + 1] i64, offsets of each node's splats
    splats: Tensor  # i32, ascending in a node


@dataclass(frozen=True)
class _Paths:
    """The tree on the device, for the descent of splats."""

    region: Tensor  # [M] i32, the smallest node of each region; -1 for none
    parents: Tensor  # [N] i64; -1 for a root
    at_depth: Tensor  # [depth, N] i64, the node itself or its ancestor at each depth; -1 below the node
    place: Tensor  # [N] i32, such that a node and all nodes below it are neighbours
    shows: Tensor  # [N, views * levels] bool (`nodes_by_level`)

    @classmethod
    def of(cls, tree: RegionTree, groups: RegionGroups, device: torch.device) -> _Paths:
        lineages = list[list[int]]()
        for node, parent in enumerate(tree.parents.tolist()):  # a node comes before its parts
            lineages.append([*(lineages[parent] if parent >= 0 else []), node])
        at_depth = np.full((max(map(len, lineages)), len(lineages)), NO_NODE)
        for node, lineage in enumerate(lineages):
            at_depth[: len(lineage), node] = lineage
        place = np.empty(len(lineages), np.int32)
        place[np.lexsort(at_depth[::-1])] = np.arange(len(lineages))
        arrays = tree.region, tree.parents.astype(np.int64), at_depth, place, nodes_by_level(tree, groups)
        return cls(*(torch.from_numpy(array).to(device) for array in arrays))


@dataclass(frozen=True)
class TreeInputsOnCard:
    """`liftcore.solve.objects.TreeInputs` on W's device."""

    W: RegionWeights  # of all views and splats, on the device
    groups: RegionGroups
    members: MembershipsOnCard

    @cached_property
    def _sizes(self) -> Tensor:
        """The number of splats of each region, [M] i64."""
        sizes = torch.zeros(self.groups.view.size, dtype=torch.int64, device=self.W.device)
        for _, _, entries in self._blocks():
            own = self.W.region[entries][self.members.own_region[entries]]
            sizes += torch.bincount(own, minlength=len(sizes))
        return sizes

    def region_sizes(self) -> np.ndarray:
        """Return the number of splats of each region, [M] i64."""
        return self._sizes.cpu().numpy()

    def containers(self, nodes: np.ndarray) -> np.ndarray:
        """See `liftcore.solve.objects.node_containers`."""
        _, group, views = node_groups(nodes, self.groups)
        number, device = nodes.size, self.W.device
        containers = np.full((number, self.groups.levels * views), UNSEEN, np.int32)
        if not number:
            return containers
        table, node_group = self._node_table(nodes), torch.from_numpy(group).long().to(device)
        weight, lengths = integer_weights(self.members.totals.sqrt(), MOST_SPLATS), table.starts.diff()
        visits = from_zero(lengths[table.splats])[table.begins].diff()
        for first, last in row_blocks(visits.cpu().numpy(), max(TABLE_ENTRIES // number, 1), BLOCK_ENTRIES):
            begins = table.begins[first : last + 1]
            splats = table.splats[slice(*begins[[0, -1]].tolist())]
            starts, entries = row_entries(table.starts, splats)
            counts = starts.diff()
            node = torch.repeat_interleave(
                torch.repeat_interleave(begins.diff(), output_size=len(splats)), counts, output_size=len(entries)
            )
            overlaps = torch.zeros((last - first) * number, dtype=torch.int64, device=device)
            overlaps.scatter_add_(
                0,
                node * number + table.members[entries],
                torch.repeat_interleave(weight[splats], counts, output_size=len(entries)),
            )
            containers[first:last] = _containing_nodes(
                overlaps.view(-1, number), first, node_group, containers.shape[1]
            )
        return containers

    def labels(self, tree: RegionTree) -> np.ndarray:
        """See `liftcore.solve.objects.node_labels`."""
        labels = torch.full((self.W.indptr.shape[0] - 1,), NO_NODE, dtype=torch.int32, device=self.W.device)
        if tree.parents.size:
            paths = _Paths.of(tree, self.groups, self.W.device)
            group = torch.from_numpy(self.groups.group).to(self.W.device)
            for first, last, entries in self._blocks():
                labels[first:last] = self._descend(first, last, entries, paths, group)
        return labels.cpu().numpy()

    def node_shares(self, labels: np.ndarray, number: int, regions: np.ndarray) -> Iterator[PieceSums]:
        """Yield per block of rows what `liftcore.solve.objects.node_shares` does per piece."""
        place = torch.from_numpy(node_numbers(regions, int(self.W.offsets[-1]))).to(self.W.device)
        label = torch.from_numpy(labels).to(self.W.device).long() + 1
        for first, last, entries in self._blocks():
            region_place = place[self.W.region[entries]]
            has_place = region_place >= 0
            row = self._rows(first, last, entries)[has_place]
            numbers = label[first:last][row] * regions.size + region_place[has_place]
            numbers, order = torch.sort(numbers, stable=True)
            starts = run_starts(numbers)
            sums = segment_sums(self.W.weight[entries][has_place][order], starts)
            yield PieceSums(numbers[starts[:-1]].cpu().numpy(), sums.cpu().numpy()[None])

    def view_weights(self, labels: np.ndarray, number: int) -> np.ndarray:
        """Return the weight of each label in each view, [number, V] f64."""
        views = self.groups.views
        sums = torch.zeros(number * views, dtype=torch.float64, device=self.W.device)
        view = torch.from_numpy(self.groups.view).to(self.W.device)
        label = torch.from_numpy(labels).to(self.W.device).long()
        for first, last, entries in self._blocks():
            entry_label = label[first:last][self._rows(first, last, entries)]
            is_labelled = entry_label >= 0
            numbers = entry_label[is_labelled] * views + view[self.W.region[entries][is_labelled]]
            sums += sums_by_number(numbers, self.W.weight[entries][is_labelled].double()[None], len(sums))[0]
        return sums.cpu().numpy().reshape(number, views)

    def _blocks(self) -> Iterator[tuple[int, int, slice]]:
        """Yield the first row, the last one + 1 and the entries of blocks of rows."""
        for first, last in self.W.blocks(BLOCK_ROWS, BLOCK_ENTRIES):
            yield first, last, slice(*self.W.indptr[[first, last]].tolist())

    def _rows(self, first: int, last: int, entries: slice) -> Tensor:
        """Return the row of each entry of a block, [n] i64, from 0 for ``first`` on."""
        lengths = self.W.indptr[first : last + 1].diff()
        return torch.repeat_interleave(lengths, output_size=entries.stop - entries.start)

    def _node_table(self, nodes: np.ndarray) -> _NodeTable:
        """Return the nodes of all splats, and of each node at most MOST_SPLATS of its splats, evenly chosen."""
        device, count = self.W.device, nodes.size
        number = torch.from_numpy(node_numbers(nodes, self.groups.view.size)).to(device)
        sizes = self._sizes[torch.from_numpy(nodes).to(device)]
        step = (sizes + MOST_SPLATS - 1) // MOST_SPLATS
        starts = torch.zeros_like(self.W.indptr)
        members = torch.empty(int(sizes.sum()), dtype=torch.int16, device=device)
        before, end, splats, splat_nodes = torch.zeros_like(sizes), 0, list[Tensor](), list[Tensor]()
        for first, last, entries in self._blocks():
            node = number[self.W.region[entries]]
            is_member = self.members.own_region[entries] & (node >= 0)
            node, row = node[is_member], self._rows(first, last, entries)[is_member]
            members[end : end + len(node)] = node.short()
            starts[first + 1 : last + 1] = torch.bincount(row, minlength=last - first).cumsum(0) + end
            end += len(node)
            node, order = torch.sort(node, stable=True)
            counts = torch.bincount(node, minlength=count)
            rank = torch.arange(len(node), device=device) + (before - counts.cumsum(0) + counts)[node]
            is_chosen = rank % step[node] == 0  # by their rank among all splats of the node
            splats.append((row[order[is_chosen]] + first).int())
            splat_nodes.append(node[is_chosen])
            before += counts
        node, order = torch.sort(torch.cat(splat_nodes), stable=True)
        begins = from_zero(torch.bincount(node, minlength=count))
        return _NodeTable(starts, members, begins, torch.cat(splats)[order])

    def _descend(self, first: int, last: int, entries: slice, paths: _Paths, group: Tensor) -> Tensor:
        """Return the smallest node of each row's path, [n] i64; -1 for none."""
        region, weight, all_rows = (
            self.W.region[entries],
            self.W.weight[entries].double(),
            self._rows(first, last, entries),
        )
        entry_node, entry_group = paths.region[region], group[region]
        index = torch.nonzero(entry_node >= 0)[:, 0]  # of the entries that may still decide
        index = index[torch.argsort(all_rows[index] * len(paths.place) + paths.place[entry_node[index]], stable=True)]
        labels = torch.full((last - first,), NO_NODE, dtype=torch.int64, device=self.W.device)
        for depth, at_depth in enumerate(paths.at_depth):
            part = at_depth[entry_node[index]]
            is_below = (part >= 0) & (paths.parents[part] == labels[all_rows[index]])
            index, part = index[is_below], part[is_below]
            if not len(index):
                break
            choice, chosen_weight = _heaviest_parts(all_rows[index], part, weight[index], index, last - first)
            if depth:
                candidate = choice[all_rows]
                is_shown = (candidate >= 0) & (entry_group >= 0) & paths.shows[candidate, entry_group]
                shown = segment_sums(weight * is_shown, self.W.indptr[first : last + 1] - entries.start)
                choice = torch.where(2.0 * chosen_weight < shown, NO_NODE, choice)
            labels = torch.where(choice >= 0, choice, labels)
        return labels


def _containing_nodes(overlaps: Tensor, first: int, group: Tensor, groups: int) -> np.ndarray:
    """Return the container of some nodes in each group, [n, groups] i32.

    Args:
        overlaps: [n, N] i64, the weight of node ``first + i``'s splats in each node. group: [N] i64.
    """
    group = group.expand(len(overlaps), -1)
    weights = overlaps.new_zeros(len(overlaps), groups).scatter_add_(1, group, overlaps).double()
    sizes = overlaps.diagonal(first).double()[:, None]  # all of a node's own splats belong to it
    observed = (weights > 0) & (weights >= OBSERVES * sizes)
    contains = observed.gather(1, group) & (overlaps.double() >= CONTAINS * weights.gather(1, group))
    row, node = torch.nonzero(contains).T  # at most one in a group: a splat belongs to one of its regions
    containers = torch.where(observed, SPLIT, UNSEEN)
    containers[row, group[0][node]] = node
    return containers.int().cpu().numpy()


def _heaviest_parts(row: Tensor, part: Tensor, weight: Tensor, index: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Return the heaviest part of each row, [rows] i64, -1 if it has less than half of all, and its weight f64.

    Args:
        row, part, weight: [n], of entries; those of one row and part are neighbours. index: [n] i64, places in W.
    """
    starts = run_starts(row * (int(part.max()) + 1) + part)
    sums, run_row, run_part = segment_sums(weight, starts), row[starts[:-1]], part[starts[:-1]]
    totals = segment_sums(sums, torch.searchsorted(run_row, torch.arange(rows + 1, device=row.device)))
    most = torch.zeros_like(totals).scatter_reduce_(0, run_row, sums, "amax")
    run = torch.repeat_interleave(starts.diff(), output_size=len(row))
    first_index = torch.zeros_like(run_row).scatter_reduce_(0, run, index, "amin", include_self=False)
    is_heaviest = sums == most[run_row]
    earliest = torch.zeros_like(totals, dtype=torch.int64).scatter_reduce_(
        0, run_row[is_heaviest], first_index[is_heaviest], "amin", include_self=False
    )
    is_chosen = is_heaviest & (first_index == earliest[run_row]) & (2.0 * sums >= totals[run_row])
    choice = torch.full_like(earliest, NO_NODE)
    choice[run_row[is_chosen]] = run_part[is_chosen]
    return choice, most
