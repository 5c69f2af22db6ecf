"""Memberships (`liftcore.solve.membership`) on a GPU, for a W in its memory: the same definition, by blocks of rows.

A group's weight at a splat is a sum over a segment: the entries of one view and one level at one splat. A **line** is
the entries of one level at one splat, and a block has its entries line by line. Sums are float64 and have a fixed
order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from liftcore.solve.membership import BELONGS, FAINT, RegionGroups
from liftcore.values.region_weights import RegionWeights, segment_sums

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 18, 1 << 22


@dataclass(frozen=True)
class MembershipsOnCard:
    """`liftcore.solve.membership.Memberships` on W's device."""

    own_region: Tensor  # [nnz] bool, the entries of W whose splat belongs to their region
    totals: Tensor  # [n] f64, the sum of each row of W


@dataclass(frozen=True)
class Segments:
    """The entries of rows ``first..last`` of W, line by line, and their segments: those of one view in a line."""

    entries: Tensor  # [n] i64, indices in W
    region: Tensor  # [n] i32
    line: Tensor  # [n] i64, (row - first) * levels + level
    segment: Tensor  # [n] i64
    starts: Tensor  # [S + 1] i64, of segments among the entries

    @classmethod
    def of(cls, W: RegionWeights, first: int, last: int, level: Tensor, levels: int, view: Tensor) -> Segments:
        """Build from the level 0..levels - 1 [M] i64 and the view [M] of each region, on W's device."""
        starts = W.indptr[first : last + 1]
        begin, end = starts[[0, -1]].tolist()
        row = torch.repeat_interleave(starts.diff(), output_size=end - begin)
        line = row * levels + level[W.region[begin:end].long()]
        order = torch.argsort(line, stable=True)
        line, entries = line[order], order + begin
        region = W.region[entries]
        begins, entry_view = torch.ones_like(line, dtype=torch.bool), view[region]
        begins[1:] = (entry_view[1:] != entry_view[:-1]) | (line[1:] != line[:-1])
        segment_starts = torch.nonzero(begins)[:, 0]
        bounds = torch.cat([segment_starts, segment_starts.new_full((1,), end - begin)])
        return cls(entries, region, line, begins.cumsum(0) - 1, bounds)


def memberships_on_card(W: RegionWeights, groups: RegionGroups) -> MembershipsOnCard:
    """Compute the memberships of all splats.

    Args:
        W: of all views by rows of codebooks, on the device; its regions are numbered as those of the groups.
    """
    group, view = (torch.from_numpy(part).to(W.device) for part in (groups.group, groups.view))
    level = torch.where(group < 0, groups.levels, group - view * groups.levels).long()
    own_region = torch.zeros(W.region.shape, dtype=torch.bool, device=W.device)
    for first, last in W.blocks(BLOCK_ROWS, BLOCK_ENTRIES):
        block = Segments.of(W, first, last, level, groups.levels + 1, view)
        weight = W.weight[block.entries].double()
        sums = segment_sums(weight, block.starts)[block.segment]
        own_region[block.entries] = (group[block.region] >= 0) & (sums > FAINT) & (weight >= BELONGS * sums)
    return MembershipsOnCard(own_region, W.row_sums())
