"""A step of `liftcore.solve.reweight` by a card, for a W that lies there: the same equations, by blocks of rows.

What `ViewConsistency` adds up entry by entry is a sum over segments here, the entries of one view at one splat. What
the other views say is the sum of all views less the own one, in float64: its digits are those of float32's sums of
the views before and behind. All sums have a fixed order, so that the same lift has the same bits on one card.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from liftcore.solve.closed_form import bag_sums
from liftcore.solve.directions import RegionDirections
from liftcore.solve.reweight import NO_CONSENSUS, SceneAgreement
from liftcore.solve.sums import PieceSums
from liftcore.values.region_weights import RegionWeights, from_zero, segment_sums

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 18, 1 << 22
TABLE_BYTES = 1 << 28  # of a table of entries by channels


@dataclass(frozen=True)
class _Block:
    """Rows ``first..last`` of W on the device, and their segments: the entries of one view in one row."""

    rows: slice
    entries: slice
    region: Tensor  # [n] i32
    weight: Tensor  # [n] f64
    share: Tensor  # [n] f64, of the row's sum, times the factors of the step before
    row: Tensor  # [n] i64, counted from the first
    segment: Tensor  # [n] i64
    starts: Tensor  # [S + 1] i64, of segments among the entries
    row_starts: Tensor  # [rows + 1] i64, of rows among the segments
    segment_row: Tensor  # [S] i64
    own: Tensor  # [n] f64 in 0..1, p: the share of the entry's view

    def row_sums(self, values: Tensor) -> Tensor:
        """Sums [rows] f64 of values of the entries [n] f64."""
        return segment_sums(segment_sums(values, self.starts), self.row_starts)


class ViewConsistencyOnCard:
    """See `liftcore.solve.reweight.ViewConsistency`.

    Args:
        W: of all views by rows of codebooks, on the device; a row for each splat.
    """

    def __init__(self, W: RegionWeights) -> None:
        self.W, self.place = W, W.device
        sums = W.row_sums()
        self.inverse = torch.where(sums > 0, 1.0 / sums, 0.0)
        self.view = torch.repeat_interleave(W.offsets.diff()).to(self.place)
        self.blocks = W.blocks(BLOCK_ROWS, BLOCK_ENTRIES)

    def totals(self) -> Tensor:
        """The weight of each region, [M] f64 on the CPU."""
        totals = torch.zeros(len(self.view), dtype=torch.float64, device=self.place)
        for first, last in self.blocks:
            own = slice(*self.W.indptr[[first, last]].tolist())
            totals += self._by_region(self.W.region[own], self.W.weight[own].double()[None])[0]
        return totals.cpu()

    def cosines(
        self,
        directions: RegionDirections,
        factors: Tensor | None,
        by_region: bool,
        add: Callable[[PieceSums], None],
    ) -> Tensor:
        """``c_jm`` of each entry, [nnz] f32 on the device; see `ViewConsistency.cosines`."""
        products, squares = torch.zeros_like(self.W.weight), torch.zeros_like(self.W.weight)
        for columns in directions.slices():
            table = directions.table(columns).to(self.place)
            for first, last in self.blocks:
                self._compare(self._block(first, last, factors), table, products, squares)
        count = len(self.view)
        sums = torch.zeros(2, count + 1, dtype=torch.float64, device=self.place)
        for first, last in self.blocks:
            block = self._block(first, last, factors)
            lengths = squares[block.entries].sqrt()
            cosines = torch.where(lengths > NO_CONSENSUS, products[block.entries] / lengths, 0.0).clamp(0.0, 1.0)
            products[block.entries] = cosines
            wide = cosines.double()
            sums[0, count] += (block.weight * wide).sum()
            sums[1, count] += block.weight.sum()
            if by_region:
                own = factors[block.entries].double() if factors is not None else 1.0
                others = block.weight * own * (1.0 - block.own)
                sums[:, :count] += self._by_region(block.region, torch.stack([others * wide, others]))
        add(PieceSums.of(sums.cpu().numpy()))
        return products

    def weigh(
        self, cosines: Tensor, factors: Tensor | None, scene: SceneAgreement, consensus: Tensor | None
    ) -> Tensor:
        """Cosines become factors in place; see `ViewConsistency.weigh`. Scores [2, n] f32 are on the CPU."""
        scores = torch.zeros(2, len(self.inverse), dtype=torch.float64, device=self.place)
        reliable = scene.regions.to(self.place)
        for first, last in self.blocks:
            block = self._block(first, last, factors)
            cosine = cosines[block.entries].double()
            blended = (1.0 - block.own) * cosine + block.own * scene.usual
            unscaled = blended * reliable.index_select(0, block.region)
            if consensus is not None:
                unscaled *= consensus[block.entries].to(self.place).double() ** scene.power
            before, after = block.row_sums(block.weight), block.row_sums(block.weight * unscaled)
            gain, has_entries = torch.where(after > 0, before / after, 0.0)[block.row], block.row_starts.diff() > 0
            cosines[block.entries] = torch.where(gain > 0, unscaled * gain, 1.0).float()
            for score, values, other in ((scores[0], cosine, 0.0), (scores[1], blended, scene.usual)):
                sums = block.row_sums(block.weight * unscaled * values)
                score[block.rows] = torch.where(after > 0, sums / after, other) * has_entries
        return scores.float().cpu()

    def _block(self, first: int, last: int, factors: Tensor | None) -> _Block:
        """Rows of W with the factors of the step before."""
        starts = self.W.indptr[first : last + 1]
        entries = slice(*starts[[0, -1]].tolist())
        region, weight = self.W.region[entries], self.W.weight[entries].double()
        row = torch.repeat_interleave(starts.diff(), output_size=len(region))
        begins = torch.ones(len(region), dtype=torch.bool, device=self.place)
        view = self.view[region]
        begins[1:] = (view[1:] != view[:-1]) | (row[1:] != row[:-1])
        segment = begins.cumsum(0) - 1
        segment_starts = torch.nonzero(begins)[:, 0]
        segment_row = row[segment_starts]
        rows = torch.arange(last - first + 1, device=self.place)
        share = weight * self.inverse[first:last][row]
        share = share if factors is None else share * factors[entries]
        bounds = torch.cat([segment_starts, segment_starts.new_full((1,), len(region))])
        own = segment_sums(share, bounds).clamp_max(1.0)[segment]
        row_starts = torch.searchsorted(segment_row, rows)
        return _Block(
            slice(first, last), entries, region, weight, share, row, segment, bounds, row_starts, segment_row, own
        )

    def _compare(self, block: _Block, table: Tensor, products: Tensor, squares: Tensor) -> None:
        """Add ``e_m . r_jv`` and ``|r_jv|^2`` of a block's entries, over the channels of the table [M, C] f32."""
        step = max(TABLE_BYTES // (4 * table.shape[1]), 1)
        if not len(block.region):
            return
        edges = torch.arange(0, len(block.segment) + step, step, device=self.place).clamp_max(len(block.segment) - 1)
        rows = torch.unique(block.row[edges]).tolist()  # whole rows, of about so many entries
        for first, last in zip(rows, [*rows[1:], len(block.row_starts) - 1], strict=True):
            at, to = block.row_starts[[first, last]].tolist()
            begin, end = block.starts[[at, to]].tolist()
            if begin == end:
                continue
            region, starts = block.region[begin:end], block.starts[at : to + 1] - begin
            view_sums = bag_sums(region, table, starts, block.share[begin:end].float()).double()
            totals = bag_sums(
                torch.arange(to - at, device=self.place), view_sums, block.row_starts[first : last + 1] - at
            )
            others = (totals[block.segment_row[at:to] - first] - view_sums).float()
            segment = block.segment[begin:end] - at
            lengths = others.square().sum(dim=1)
            for part in range(0, end - begin, step):  # of a row with more entries than that
                few = slice(part, min(part + step, end - begin))
                place = slice(block.entries.start + begin + few.start, block.entries.start + begin + few.stop)
                products[place] += (table[region[few]] * others[segment[few]]).sum(dim=1)
                squares[place] += lengths[segment[few]]

    def _by_region(self, region: Tensor, values: Tensor) -> Tensor:
        """Sums [k, M] f64 of values [k, n] f64 of entries by their regions [n] i32, in the entries' order."""
        starts = from_zero(torch.bincount(region, minlength=len(self.view)))
        order = torch.argsort(region, stable=True)
        return torch.stack([segment_sums(part[order], starts) for part in values])
