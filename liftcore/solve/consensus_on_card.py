"""Mask consensus (`liftcore.solve.consensus`) on a GPU, for a W in its memory: the same definition and samples.

Regions of masks are numbered without the cells of grids, which take no part. For a block of regions, R is a dense
table [b, M] of integers, in units that cannot overflow: integer sums are the same in any order of threads, so a lift
is bitwise reproducible. Sampled splats add to it, and dividing by vis makes it the table of q.

The processor computes the best level of a tuple once. Here each splat has a row of **witnesses**, the members of its
evenly chosen views by slot and level, and every entry reads the q of them all: this needs no tuples. Entries are
read by their number of slots. A missing member is the region after the last, whose q is that of no view.

Time grows with the square of M, while the R of the processor is sparse, and faster for more than MOST_MASKS regions,
as of maps with a region a pixel.

Beside W, the device holds a result of 5 bytes per entry, 4 bytes per membership, 4 per witness of a splat (up to
MOST_WITNESSES views by the number of levels), and less than 2 GiB of blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.closed_form import morton_codes
from liftcore.solve.consensus import MOST_SPLATS, MOST_WITNESSES, OBSERVES, ONE_VIEW, PRIOR, STEPS, mean_share
from liftcore.solve.membership import RegionGroups
from liftcore.solve.membership_on_card import MembershipsOnCard, memberships_on_card
from liftcore.solve.sums_on_card import integer_weights
from liftcore.values.region_weights import RegionWeights, from_zero, row_blocks, row_entries

BLOCK_ENTRIES = 1 << 24  # of some regions; each block reads all regions of W
TABLE_CELLS = 1 << 24  # of R
MOST_MASKS = 1 << 17  # M, of whose R all cells are computed
CHUNK = 1 << 23  # entries of W, members or witnesses of splats that are read at a time


def mask_consensus_on_card(
    W: RegionWeights, levels: np.ndarray, *, means: Tensor | None = None, members: MembershipsOnCard | None = None
) -> Tensor:
    """Return c_jm of every entry of W, [nnz] f32 on its device (`liftcore.solve.consensus.mask_consensus`).

    Args:
        W: of all views, by rows of codebooks, on the device.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which are ignored.
        means: [P, 3] of the splats, on any device. members: of W, if computed before.
    """
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    own = members or memberships_on_card(W, groups)
    masks = _Masks.of(groups, W.device)
    shares = torch.zeros(W.region.shape, dtype=torch.float32, device=W.device)  # sums of q over the observing views
    views = torch.zeros(W.region.shape, dtype=torch.uint8, device=W.device)  # their number
    share_sum, share_count = 0, 0
    splats, sizes = _Splats.of(W, own, masks), _sizes(W, masks)
    rank = _ranks(W, means)
    for first, last in row_blocks(sizes, max(masks.count, 1), BLOCK_ENTRIES):
        entries, row = _by_region(W, masks, rank, first, last)
        if not len(entries):
            continue
        packed = torch.empty_like(entries)
        ends = np.concatenate([[0], np.cumsum(sizes[first:last])]).tolist()
        for a, b in row_blocks(sizes[first:last], max(TABLE_CELLS // (masks.count + 1), 1), BLOCK_ENTRIES):
            part = slice(ends[a], ends[b])
            is_own = own.own_region[entries[part]]
            packed[part] = _compare(splats, masks, first + a, sizes[first + a : first + b], row[part], is_own)
        sums = packed & ONE_VIEW - 1
        packed //= ONE_VIEW
        shares[entries], views[entries] = (sums.double() / STEPS).float(), packed.to(torch.uint8)
        share_sum, share_count = share_sum + int(sums.sum()), share_count + int(packed.sum())
    mean = mean_share(share_sum, share_count)
    for first in range(0, len(shares), CHUNK):
        block = slice(first, first + CHUNK)
        shares[block] = ((shares[block].double() + PRIOR * mean) / (views[block].double() + PRIOR)).float()
    return shares


@dataclass(frozen=True)
class _Masks:
    """The regions that are masks, numbered from 0 on."""

    number: Tensor  # [regions of W] i32, M for cells of grids
    group: Tensor  # [M] i64
    view: Tensor  # [M] i64
    group_view: Tensor  # [groups] i64
    levels: int

    @classmethod
    def of(cls, groups: RegionGroups, place: torch.device) -> _Masks:
        is_mask = groups.group >= 0
        number = np.where(is_mask, np.cumsum(is_mask) - 1, is_mask.sum()).astype(np.int32)
        group_view = np.repeat(np.arange(groups.views), groups.levels)
        parts = number, groups.group[is_mask].astype(np.int64), groups.view[is_mask].astype(np.int64), group_view
        numbers, group, view, group_views = (torch.from_numpy(part).to(place) for part in parts)
        return cls(numbers, group, view, group_views, groups.levels)

    @property
    def count(self) -> int:
        """M."""
        return len(self.group)


@dataclass(frozen=True)
class _Splats:
    """The masks to which each splat belongs, ascending, and its witnesses."""

    starts: Tensor  # [P + 1] i64, of members
    members: Tensor  # i32
    witnesses: Tensor  # [P, most slots, levels] i32, M for none
    slots: Tensor  # [P] i64, chosen views of each splat
    weights: Tensor  # [P] i64, t_j in units of which MOST_SPLATS times the largest do not overflow

    @classmethod
    def of(cls, W: RegionWeights, own: MembershipsOnCard, masks: _Masks) -> _Splats:
        """Build from the memberships of W."""
        blocks, counts = W.blocks(CHUNK, CHUNK >> 1), torch.zeros_like(W.indptr)
        views, members = counts[1:].clone(), []
        for first, last in blocks:
            row, member, view = _members(W, own, masks, first, last)
            members.append(member)
            counts[first + 1 : last + 1] = torch.bincount(row, minlength=last - first)
            views[first:last].scatter_reduce_(0, row, view + 1, "amax")
        strides = ((views + MOST_WITNESSES - 1) // MOST_WITNESSES).clamp_min(1)
        slots = (views + strides - 1) // strides
        shape = len(views), int(slots.max()) if len(views) else 0, masks.levels
        witnesses = torch.full(shape, masks.count, dtype=torch.int32, device=W.device)
        for first, last in blocks:
            row, member, view = _members(W, own, masks, first, last)
            stride = strides[first:last][row]
            chosen = torch.nonzero(view % stride == 0)[:, 0]
            row, member, slot = row[chosen], member[chosen], (view // stride)[chosen]
            witnesses[row + first, slot, masks.group[member] % masks.levels] = member
        members = torch.cat(members) if members else W.region[:0]
        return cls(counts.cumsum(0), members, witnesses, slots, integer_weights(own.totals, MOST_SPLATS))


def _members(
    W: RegionWeights, own: MembershipsOnCard, masks: _Masks, first: int, last: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the row - first, the mask, and the number of the view in the row of each membership of some rows."""
    starts = W.indptr[first : last + 1]
    begin, end = starts[[0, -1]].tolist()
    entries = torch.nonzero(own.own_region[begin:end])[:, 0]
    member = masks.number[W.region[begin:end][entries]]
    row = torch.searchsorted(starts - begin, entries, right=True) - 1
    begins, view = torch.ones_like(row, dtype=torch.bool), masks.view[member]
    begins[1:] = (view[1:] != view[:-1]) | (row[1:] != row[:-1])
    number = begins.cumsum(0)
    return row, member, number - number[torch.searchsorted(row, row)]


def _ranks(W: RegionWeights, means: Tensor | None) -> Tensor:
    """Return the place [P] i64 of each splat with entries in the order in which splats are read."""
    rank = torch.arange(len(W.splats), device=W.device)
    if means is not None:
        rows = torch.nonzero(W.indptr.diff())[:, 0]
        order = torch.argsort(morton_codes(means.to(W.device)[rows]), stable=True)
        rank[rows[order]] = torch.arange(len(rows), device=W.device)
    return rank


def _sizes(W: RegionWeights, masks: _Masks) -> np.ndarray:
    """Return the number of entries of each mask, [M] i64."""
    sizes = torch.zeros(masks.count + 1, dtype=torch.int64, device=W.device)
    for first in range(0, len(W.region), CHUNK):
        sizes += torch.bincount(masks.number[W.region[first : first + CHUNK]], minlength=masks.count + 1)
    return sizes[:-1].cpu().numpy()


def _by_region(W: RegionWeights, masks: _Masks, rank: Tensor, first: int, last: int) -> tuple[Tensor, Tensor]:
    """Return the entries of the masks ``first..last`` and their rows, by mask and in the order of splats."""
    pieces = []
    for begin in range(0, len(W.region), CHUNK):
        number = masks.number[W.region[begin : begin + CHUNK]]
        pieces.append(torch.nonzero((number >= first) & (number < last))[:, 0] + begin)
    entries = torch.cat(pieces) if pieces else W.indptr[:0]
    row = torch.searchsorted(W.indptr, entries, right=True) - 1
    order = torch.argsort((masks.number[W.region[entries]].long() - first) * len(rank) + rank[row])
    return entries[order], row[order]


def _compare(splats: _Splats, masks: _Masks, first: int, sizes: np.ndarray, row: Tensor, is_own: Tensor) -> Tensor:
    """Return the sum of q in STEPS plus ONE_VIEW for each observing view, [n] i64, of the entries of some masks.

    Args:
        first, sizes: the first mask, and the number of entries [b] i64 of each.
        row, is_own: [n], of the entries, by mask and in the order of splats.
    """
    lengths = torch.from_numpy(sizes).to(row.device)
    mask = torch.repeat_interleave(lengths, output_size=len(row))
    place = torch.arange(len(row), device=row.device) - from_zero(lengths)[mask]
    steps = ((lengths + MOST_SPLATS - 1) // MOST_SPLATS).clamp_min(1)
    sampled = torch.nonzero(is_own & (place % steps[mask] == 0))[:, 0]
    table = _shares(splats, masks, first, len(sizes), row[sampled], mask[sampled])
    packed, slots = torch.zeros_like(row), splats.slots[row]
    order = torch.argsort(slots, descending=True)  # so that a chunk has splats of about as many slots
    counts = torch.bincount(slots).flip(0).cumsum(0).cpu().numpy()  # of entries, from the most slots down
    begin, width = 0, len(counts) - 1
    while begin < len(row) and width > 0:
        part = order[begin : begin + max(CHUNK // (width * masks.levels), 1)]
        cells = splats.witnesses[:, :width].index_select(0, row[part])
        cells += (mask[part] * table.shape[1]).int()[:, None, None]
        packed[part] = table.view(-1).index_select(0, cells.view(-1)).view_as(cells).amax(dim=2).sum(dim=1)
        begin += len(part)
        width = len(counts) - 1 - int(np.searchsorted(counts, begin, side="right"))
    return packed


def _shares(splats: _Splats, masks: _Masks, first: int, count: int, row: Tensor, mask: Tensor) -> Tensor:
    """Return ONE_VIEW + q in STEPS of ``count`` masks with all masks, [b, M + 1] i64; 0 if it is not observed.

    Args:
        row, mask: [n] i64, sampled splats of these masks, and mask - first.
    """
    table = torch.zeros(count, masks.count + 1, dtype=torch.int64, device=row.device)
    ends = (splats.starts[row + 1] - splats.starts[row]).cumsum(0)
    chunks = int(ends[-1]) // CHUNK if len(ends) else 0
    cuts = torch.searchsorted(ends, CHUNK * torch.arange(1, chunks + 1, device=row.device)).tolist()
    for begin, end in pairwise([0, *cuts, len(row)]):
        starts, places = row_entries(splats.starts, row[begin:end])
        pair = torch.repeat_interleave(starts.diff(), output_size=len(places))
        cells, weights = table.shape[1] * mask[begin:end], splats.weights[row[begin:end]]
        table.view(-1).scatter_add_(0, cells[pair] + splats.members[places], weights[pair])
    R, own = table[:, :-1], torch.arange(first, first + count, device=row.device)
    vis = R.new_zeros(count, len(masks.group_view)).index_add_(1, masks.group, R)
    observed = vis >= OBSERVES * R.gather(1, own[:, None]).double()
    vis *= observed & (masks.group_view != masks.view[own][:, None])
    seen = vis.double().index_select(1, masks.group)
    R.copy_(torch.where(seen > 0, ((R / seen) * STEPS + 0.5).long() + ONE_VIEW, 0))
    return table
