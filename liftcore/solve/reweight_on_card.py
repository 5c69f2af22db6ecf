"""A step of `liftcore.solve.reweight` on a GPU, for a W in its memory: the same equations, by blocks of rows.

Sums of `BlockReweighter` over entries are sums over segments here (`liftcore.solve.membership_on_card`): the entries
of one view and one level at one splat. The sum of the other views is that of all views minus the own view, in
float64, as a float32 difference would lose digits. All sums have a fixed order: a lift is bitwise reproducible on the
same GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.closed_form import bag_sums
from liftcore.solve.directions import RegionDirections
from liftcore.solve.membership_on_card import BLOCK_ENTRIES, BLOCK_ROWS, Segments
from liftcore.solve.reweight import NO_CONSENSUS, SceneConsistency, level_numbers
from liftcore.solve.sums import PieceSums
from liftcore.solve.sums_on_card import sums_by_number
from liftcore.values.region_weights import RegionWeights, segment_sums

TABLE_BYTES = 1 << 28  # of a table of entries by channels


@dataclass(frozen=True)
class _Block:
    """Rows ``first..last`` of W on the device, and their segments: the entries of one view in one line."""

    rows: slice
    entries: Tensor  # [n] i64, indices in W, line by line
    region: Tensor  # [n] i32
    weight: Tensor  # [n] f64
    share: Tensor  # [n] f64, of the line's sum, times the factors of the step before
    line: Tensor  # [n] i64, counted from the first
    segment: Tensor  # [n] i64
    starts: Tensor  # [S + 1] i64, of segments among the entries
    line_starts: Tensor  # [lines + 1] i64, of lines among the segments
    segment_line: Tensor  # [S] i64
    view_share: Tensor  # [n] f64 in 0..1, p: the share of the entry's view

    def line_sums(self, values: Tensor) -> Tensor:
        """Return sums [lines] f64 of values of the entries [n] f64."""
        return segment_sums(segment_sums(values, self.starts), self.line_starts)


class BlockReweighterOnCard:
    """`liftcore.solve.reweight.BlockReweighter` on a device.

    Args:
        W: of all views by rows of codebooks, on the device; a row for each splat.
        levels: [M] i8, of each region, -1 for cells of grids; None: one level.
    """

    def __init__(self, W: RegionWeights, levels: np.ndarray | None = None) -> None:
        self.W, self.place = W, W.device
        self.level = level_numbers(levels, int(W.offsets[-1]))
        self.levels = int(self.level.max(initial=0)) + 1
        self.region_level = torch.from_numpy(self.level).long().to(self.place)
        self.view = torch.repeat_interleave(W.offsets.diff()).to(self.place)
        self.blocks = W.blocks(BLOCK_ROWS, BLOCK_ENTRIES)

    def cosines(
        self,
        directions: RegionDirections,
        factors: Tensor | None,
        by_region: bool,
        add: Callable[[PieceSums], None],
    ) -> Tensor:
        """Return ``c_jm`` of each entry, [nnz] f32 on the device; see `BlockReweighter.cosines`."""
        products, squares = torch.zeros_like(self.W.weight), torch.zeros_like(self.W.weight)
        for columns in directions.slices():
            table = directions.table(columns).to(self.place)
            for first, last in self.blocks:
                self._compare(self._block(first, last, factors), table, products, squares)
        count = len(self.view)
        sums = torch.zeros(2, count + self.levels, dtype=torch.float64, device=self.place)
        for first, last in self.blocks:
            block = self._block(first, last, factors)
            lengths = squares[block.entries].sqrt()
            cosines = torch.where(lengths > NO_CONSENSUS, products[block.entries] / lengths, 0.0).clamp(0.0, 1.0)
            products[block.entries] = cosines
            wide = cosines.double()
            lines = torch.stack([block.line_sums(block.weight * wide), block.line_sums(block.weight)])
            sums[:, count:] += lines.reshape(2, -1, self.levels).sum(dim=1)
            if by_region:
                scale = factors[block.entries].double() if factors is not None else 1.0
                other_weight = block.weight * scale * (1.0 - block.view_share)
                sums[:, :count] += sums_by_number(
                    block.region, torch.stack([other_weight * wide, other_weight]), count
                )
        add(PieceSums.of(sums.cpu().numpy()))
        return products

    def weigh(
        self, cosines: Tensor, factors: Tensor | None, scene: SceneConsistency, consensus: Tensor | None
    ) -> Tensor:
        """Replace cosines by factors in place (`BlockReweighter.weigh`); return the scores [2, n] f32 on the CPU."""
        scores = torch.zeros(2, self.W.indptr.shape[0] - 1, dtype=torch.float64, device=self.place)
        reliable, mean_cosine, power = (
            part.to(self.place) for part in (scene.regions, scene.mean_cosine, scene.power)
        )
        for first, last in self.blocks:
            block = self._block(first, last, factors)
            cosine, level = cosines[block.entries].double(), block.line % self.levels
            blended = (1.0 - block.view_share) * cosine + block.view_share * mean_cosine[level]
            unscaled = blended * reliable.index_select(0, block.region)
            if consensus is not None:
                block_entries = slice(*self.W.indptr[[first, last]].tolist())
                unscaled *= (
                    consensus[block_entries].to(self.place)[block.entries - block_entries.start].double()
                    ** power[level]
                )
            before, after = block.line_sums(block.weight), block.line_sums(block.weight * unscaled)
            gain = torch.where(after > 0, before / after, 0.0)
            entry_gain, has_entries = gain[block.line], self.W.indptr[first : last + 1].diff() > 0
            cosines[block.entries] = torch.where(entry_gain > 0, unscaled * entry_gain, 1.0).float()
            totals = before.reshape(-1, self.levels).sum(dim=1)
            for score, values, other in (
                (scores[0], cosine, torch.zeros_like(mean_cosine)),
                (scores[1], blended, mean_cosine),
            ):
                sums = gain * block.line_sums(block.weight * unscaled * values)
                sums = torch.where(after > 0, sums, before * other.repeat(len(totals)))
                mean = torch.where(totals > 0, sums.reshape(-1, self.levels).sum(dim=1) / totals, other[0])
                score[block.rows] = mean * has_entries
        return scores.float().cpu()

    def _block(self, first: int, last: int, factors: Tensor | None) -> _Block:
        """Return rows of W with the factors of the step before."""
        block = Segments.of(self.W, first, last, self.region_level, self.levels, self.view)
        entries, line, bounds, lines = block.entries, block.line, block.starts, (last - first) * self.levels
        weight, segment_line = self.W.weight[entries].double(), line[bounds[:-1]]
        line_starts = torch.searchsorted(segment_line, torch.arange(lines + 1, device=self.place))
        totals = segment_sums(segment_sums(weight, bounds), line_starts)
        share = weight * torch.where(totals > 0, 1.0 / totals, 0.0)[line]
        share = share if factors is None else share * factors[entries]
        view_share = segment_sums(share, bounds).clamp_max(1.0)[block.segment]
        return _Block(
            slice(first, last), entries, block.region, weight, share, line, block.segment, bounds, line_starts,
            segment_line, view_share,
        )  # fmt: skip

    def _compare(self, block: _Block, table: Tensor, products: Tensor, squares: Tensor) -> None:
        """Add ``e_m . r_jv`` and ``|r_jv|^2`` of a block's entries, over the channels of the table [M, C] f32."""
        step = max(TABLE_BYTES // (4 * table.shape[1]), 1)
        if not len(block.region):
            return
        edges = torch.arange(0, len(block.segment) + step, step, device=self.place).clamp_max(len(block.segment) - 1)
        lines = torch.unique(block.line[edges]).tolist()  # whole lines, of about ``step`` segments
        for first, last in zip(lines, [*lines[1:], len(block.line_starts) - 1], strict=True):
            at, to = block.line_starts[[first, last]].tolist()
            begin, end = block.starts[[at, to]].tolist()
            if begin == end:
                continue
            region, starts = block.region[begin:end], block.starts[at : to + 1] - begin
            view_sums = bag_sums(region, table, starts, block.share[begin:end].float()).double()
            totals = bag_sums(
                torch.arange(to - at, device=self.place), view_sums, block.line_starts[first : last + 1] - at
            )
            other_views = (totals[block.segment_line[at:to] - first] - view_sums).float()
            segment = block.segment[begin:end] - at
            lengths = other_views.square().sum(dim=1)
            for part in range(0, end - begin, step):  # a line may have more entries
                few = slice(part, min(part + step, end - begin))
                place = block.entries[begin + few.start : begin + few.stop]
                products[place] += (table[region[few]] * other_views[segment[few]]).sum(dim=1)
                squares[place] += lengths[segment[few]]
