"""Robust reweighting of W: each weight W_jm is scaled by how well region m agrees with the other views at splat j.

With e_m the direction of region m (`liftcore.solve.directions`), its weight in view v at splat j becomes::

    W'_jm = s_j W_jm ((1 - p_jv) c_jm + p_jv c),     c_jm = max(0, cos(e_m, r_jv))
    r_jv = sum of W_jn e_n over the regions n of all other views,     c = sum W c_jm / sum W over the scene

``p_jv`` is the share of view v in the weight of splat j, and ``s_j`` restores the sum of weights of the splat, so
denominators, ``has_feature`` and total weight do not change. There are no tuned parameters; the reason for each part:

- **Other views are the reference, never the region itself.** A region's vector is noisy, and the noise of a heavy
  region pulls the splat's mean towards it. Compared with that mean, a region is rewarded for its own noise, most
  where a splat has few regions: this, not the bandwidth, made reweighting by the distance to x_j fail on masks. All
  regions of a view are excluded together, as levels and neighbouring cells share their errors.
- **The own view counts by its share.** Without ``p c`` a minority of agreeing views outvotes a view with most of the
  weight, and splats that one view sees well take the features that leak to them in the others. For the own view the
  scene's mean cosine c is used, as the measured one would be noise again.
- **The cosine itself is the weight.** If ``e_m = a_m x + noise``, the cosine estimates a_m up to a factor, and
  weights proportional to the signal give the least noise. There is no bandwidth; a region of two merged objects keeps
  part of its weight, and a region that points away from the others loses it.

**Levels are separate where they disagree.** A whole and its part may have different vectors, and both are correct:
their sum is neither, and at every border objects with the same vector on two levels would outvote the others. Where
masks of parts and wholes differ (`NodeVectors.must_separate`), the step runs once a level, with W of this level
alone, so each level keeps its weight at each splat. Cells of grids are one level. Levels that agree are compared
together, as each adds an observation, which matters with few views.

A splat of one view does not change. A region without direction (a zero vector, or the mean itself) has c_jm = 0, and
if no region of the scene has a direction, nothing changes.

**Region reliability** is the same for a region as a whole, as some errors hold at all its splats: a wrong word, a
mask of two objects. With ``p`` as above, region m of view v has::

    r_m = sum_j W_jm (1 - p_jv) c_jm / sum_j W_jm (1 - p_jv)        r = the median of r_m over the regions

and all its entries get the factor ``r_m / r``. Parts of a region that no other view sees are no evidence, so the
weights are those of the other views. A second pass would compare with the result of the first, and is worse. Cells
of a grid do not claim that their splats are one object, so they have no reliability: cells across an edge would lose
their weight there.

**Mask consensus** (`consensus`) enters as ``q_jm^(SHARPNESS (1 - r))``: where features agree, they reveal wrong masks
themselves, and geometry counts more the less they agree. This exponent leaves correct masks unchanged.

**Confidence** of a splat is the mean of c_jm over its entries, by their final weights: the agreement of independent
views.

**Blocks of splats.** Cosines, factors and scores are functions of a splat's own row of W (`BlockReweighter`, on any
block of splats). From the scene they need c, r and the r_m: sums over all splats, by pieces (`SceneConsistency`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.runtime.memory import zeros
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.directions import RegionDirections
from liftcore.solve.shared_rows import compare_rows, flat_table
from liftcore.solve.sums import PieceSums, piece_sums
from liftcore.values.region_weights import MEMORY_LIMIT, RegionWeights, row_blocks, run_each

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 11, 1 << 15  # a splat has a sum per view
POWERS = 1 << 12  # table size of powers of consensus; linear interpolation has a relative error of 3e-5 at most
STEEP = np.float32(1 / 16)  # consensus below which interpolation is inaccurate; few entries are below
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is the rounding error of inputs that cancel
SHARPNESS = 4.0  # the largest value that costs correct masks at most .001 of accuracy in any scene (docs/method.md)


def reweighting_facts(
    levels: np.ndarray, reliability: float | None, confidence: Tensor | None, levels_apart: bool
) -> dict[str, Any]:
    """Return the facts of a reweighting for the diagnostics.

    Args:
        levels: [M] i8, -1 for cells of grids. confidence: [P] f32.
        levels_apart: True if regions were compared with those of their own level only.
    """
    facts: dict[str, Any] = {"masks": int((levels >= 0).sum()), "levels_apart": levels_apart}
    if reliability is not None:
        facts["reliability_median"] = reliability
    if confidence is not None:
        facts["confidence_mean"] = float(confidence.numpy().mean(dtype=np.float64))
    return facts


def scale_weights(W: RegionWeights, factors: Tensor) -> RegionWeights:
    """Return W with each entry times its factor [nnz] f32, in the memory of the factors."""
    return replace(W, weight=torch.mul(W.weight, factors, out=factors))


@dataclass(frozen=True)
class SceneConsistency:
    """Quantities of the whole scene that a step needs; those of L levels that are compared apart."""

    mean_cosines: np.ndarray  # [L] f64, c
    powers: np.ndarray  # [L] f64, exponents of the consensus, SHARPNESS (1 - r)
    regions: np.ndarray  # [M] f32, r_m / r of each region; 1 for regions without a reliability

    @classmethod
    def of(cls, sums: np.ndarray, level: np.ndarray, mask: np.ndarray) -> "SceneConsistency":
        """Compute from the sums of `BlockReweighter.cosines` over all splats.

        Args:
            sums: [2, M + L] f64. level: [M] i8. mask: [M] bool, the regions with a reliability.
        """
        confirmed, totals = sums[:, level.size :]
        mean_cosines = np.divide(confirmed, totals, out=np.zeros_like(totals), where=totals > 0)
        regions, powers = np.ones(level.size, np.float32), np.ones_like(totals)
        for number in range(totals.size):
            of_level = mask & (level == number)
            if mask.any():
                median = median_reliability(sums, of_level) or 0.0
                powers[number] = SHARPNESS * (1.0 - median)
                if median > 0:
                    seen, reliable = _reliabilities(sums, of_level)
                    regions[seen] = reliable / median
        return cls(mean_cosines, powers, regions)


def _reliabilities(sums: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the regions of a mask that other views see, [n] i64, and their r_m [n] f64."""
    confirmed, totals = sums[:, : mask.size]
    seen = np.flatnonzero((totals > 0) & mask)
    return seen, confirmed[seen] / totals[seen]


def median_reliability(sums: np.ndarray, mask: np.ndarray) -> float | None:
    """Return r, the lower median over the regions [M] of a mask that other views see; None if there is none."""
    reliable = np.sort(_reliabilities(sums, mask)[1])
    return float(reliable[(reliable.size - 1) // 2]) if reliable.size else None


class BlockReweighter:
    """Cosines, factors and scores of a block of splats that begins at a piece (`liftcore.solve.sums`).

    Args:
        W: of all views by rows of codebooks, on the CPU; a row for each splat of the block.
        level: [M] i8, from 0 on; regions are compared with those of their level alone.
        means: [n, 3] of these splats; neighbours, which read the same directions, are processed together.
    """

    def __init__(self, W: RegionWeights, level: np.ndarray, means: Tensor | None, threads: int | None) -> None:
        self.W, self.threads = W, threads
        self.view = torch.repeat_interleave(W.offsets.diff()).numpy()
        self.rows = torch.nonzero(W.indptr.diff())[:, 0]
        if means is not None:
            self.rows = self.rows[torch.argsort(morton_codes(means[self.rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
        self.level, self.levels = level, int(level.max(initial=0)) + 1
        self.shape = 2, level.size + self.levels

    def cosines(self, directions: RegionDirections, by_region: bool) -> tuple[Tensor, Iterator[PieceSums]]:
        """Return ``c_jm`` of the entries, level after level, [nnz] f32, complete once the sums are read.

        Args:
            by_region: True to compute the sums of reliability.

        Returns:
            The cosines, and the sums of each level and piece [2, M + levels]: ``W (1 - p) c`` and ``W (1 - p)`` of
            each region and, from place M on, ``W c`` and ``W`` of each level.
        """
        products = _zeros(self.W)
        return products, self._sums(products, directions, by_region)

    def _sums(self, products: Tensor, directions: RegionDirections, by_region: bool) -> Iterator[PieceSums]:
        for number, (W, entries, _) in enumerate(self._by_level()):
            squares = _zeros(W)
            values = [products[entries].numpy(), squares.numpy()]
            for columns in directions.slices():
                table, width = flat_table(directions.table(columns)), columns.stop - columns.start
                arrays = [table, width, *self._arrays(W), *values]
                blocks = [(self.rows[first:last].numpy(), *arrays) for first, last in self.blocks]
                run_each(compare_rows, blocks, self.threads)
            arrays = [*self._arrays(W), *values, self.level.size + number, by_region]

            def add_rows(first: int, last: int, table: np.ndarray, arrays: list[Any] = arrays) -> None:
                tally(*[first, last, *arrays, table])

            yield from piece_sums(add_rows, W.indptr.shape[0] - 1, self.shape, self.threads)

    def weigh(self, cosines: Tensor, scene: SceneConsistency, consensus: Tensor | None, scores: np.ndarray) -> None:
        """Replace cosines by factors ``s ((1 - p) c_jm + p c) (r_m / r) q^power`` in the order of W, in place.

        Args:
            cosines: [nnz] f32, of `cosines`.
            consensus: [nnz] f32 of each entry of W (`liftcore.solve.consensus`); None: no consensus.
            scores: [2, n] f64, to which ``sum W' c_jm`` and ``sum W`` of each splat are added.
        """
        by_level = _zeros(self.W).copy_(cosines) if self.levels > 1 else cosines
        levels = zip(self._by_level(), scene.mean_cosines, scene.powers, strict=True)
        for (W, entries, places), mean_cosine, power in levels:
            factors = by_level[entries]
            shares = torch.zeros(0, dtype=torch.float32) if consensus is None else consensus[places]
            powers = ((np.arange(POWERS + 2) / POWERS) ** power).astype(np.float32)
            arrays = [*self._arrays(W), factors.numpy(), shares.numpy(), scene.regions, scores]
            # In the order of memory: nothing is shared by neighbours, unlike in `cosines`.
            blocks = W.blocks(BLOCK_ROWS, BLOCK_ENTRIES)
            run_each(weigh_rows, [(*ends, *arrays, mean_cosine, power, powers) for ends in blocks], self.threads)
            if self.levels > 1:
                cosines[places] = factors

    def _by_level(self) -> Iterator[tuple[RegionWeights, slice, Any]]:
        """Yield W with the entries of each level alone, where these lie level after level, and where in W."""
        if self.levels == 1:
            yield self.W, slice(None), slice(None)
            return
        level_of_entry, end = self.level[self.W.region.numpy()], 0
        for number in range(self.levels):
            places = torch.from_numpy(np.flatnonzero(level_of_entry == number))
            starts = torch.searchsorted(places, self.W.indptr)
            begin, end = end, end + places.shape[0]
            W = replace(self.W, indptr=starts, region=self.W.region[places], weight=self.W.weight[places])
            yield W, slice(begin, end), places

    def _arrays(self, W: RegionWeights) -> list[np.ndarray]:
        """Return the arrays of W, and the view of each region."""
        return [*(part.numpy() for part in (W.indptr, W.region, W.weight)), self.view]


def _zeros(W: RegionWeights) -> Tensor:
    """Return zeros for the entries of W, [nnz] f32."""
    size = W.weight.nbytes
    return zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)


def confidence_of(scores: np.ndarray) -> Tensor:
    """Return the confidence [n] f32 of splats from the scores of `BlockReweighter.weigh`; 0 without weight."""
    agreement, total = scores
    return torch.from_numpy(np.divide(agreement, total, out=np.zeros_like(total), where=total > 0)).float()


@kernel
def weigh_rows(
    first_row,
    last_row,
    indptr,
    region,
    weight,
    view,
    cosines,
    consensus,
    reliable,
    scores,
    mean_cosine,
    power,
    powers,
):
    """Compute `BlockReweighter.weigh` of a level in rows ``first_row..last_row``.

    Powers of consensus are interpolated in a table [n].
    """
    for row in range(first_row, last_row):
        first, last = indptr[row], indptr[row + 1]
        before = after = cosine_sum = 0.0
        for k in range(first, last):
            before += weight[k]
        inverse = 1.0 / before if before > 0.0 else 0.0
        k = first
        while k < last:
            begin, v, view_share = k, view[region[k]], 0.0
            while k < last and view[region[k]] == v:
                view_share += weight[k] * inverse
                k += 1
            share = min(view_share, 1.0)
            for n in range(begin, k):
                scaled = ((1.0 - share) * cosines[n] + share * mean_cosine) * reliable[region[n]]
                if consensus.size > 0:
                    if consensus[n] > STEEP:
                        place = consensus[n] * np.float32(POWERS)
                        i = np.int64(place)
                        scaled *= powers[i] + (place - np.float32(i)) * (powers[i + 1] - powers[i])
                    else:
                        scaled *= consensus[n] ** np.float32(power)
                after += weight[n] * scaled
                cosine_sum += weight[n] * scaled * cosines[n]
                cosines[n] = scaled
        gain = before / after if after > 0.0 else 0.0
        scores[0, row] += gain * cosine_sum
        scores[1, row] += before
        for n in range(first, last):
            cosines[n] = cosines[n] * gain if gain > 0.0 else 1.0


@kernel
def tally(first, last, indptr, region, weight, view, cosines, squares, place, by_region, sums):
    """Replace products of a level in some rows by cosines; add these to the sums [2, M + levels] f64."""
    for row in range(first, last):
        total = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            total += weight[k]
        inverse = 1.0 / total if total > 0.0 else 0.0
        k = indptr[row]
        while k < indptr[row + 1]:
            begin, v, view_share = k, view[region[k]], 0.0
            while k < indptr[row + 1] and view[region[k]] == v:
                length = np.sqrt(squares[k])
                cosine = cosines[k] / length if length > NO_CONSENSUS else np.float32(0.0)
                cosines[k] = min(max(cosine, np.float32(0.0)), np.float32(1.0))
                sums[0, place] += weight[k] * np.float64(cosines[k])
                sums[1, place] += weight[k]
                view_share += weight[k] * inverse
                k += 1
            other_share = max(1.0 - view_share, 0.0)
            for n in range(begin, k if by_region else begin):
                sums[0, region[n]] += weight[n] * other_share * cosines[n]
                sums[1, region[n]] += weight[n] * other_share
