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
masks of parts and wholes differ (`NodeVectors.levels_disagree`), p, c, r, s and all sums are computed among the
regions of one level, and each level keeps its weight at each splat. Cells of grids are one level. Levels that agree
are compared together, as each adds an observation, which matters with few views.

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

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.codebook import Codebook
from liftcore.solve.directions import RegionDirections
from liftcore.solve.shared_rows import compare_rows, flat_table
from liftcore.solve.sums import PieceSums, piece_sums
from liftcore.values.region_weights import MEMORY_LIMIT, RegionWeights, row_blocks, run_each
from liftcore.values.settings import DIRECTIONS

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 11, 1 << 15  # a splat has a sum per view
POWERS = 1 << 12  # table size of powers of consensus; linear interpolation has a relative error of 3e-5 at most
STEEP = np.float32(1 / 16)  # consensus below which interpolation is inaccurate; few entries are below
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is the rounding error of inputs that cancel
SHARPNESS = 4.0  # the largest value that costs correct masks at most .001 of accuracy in any scene (docs/method.md)


@dataclass(frozen=True)
class Reweighting:
    """Factors and scores of a reweighting of W."""

    factors: Tensor  # [nnz] f32, of each entry of W; the sums of rows do not change
    confidence: Tensor  # [P] f32 in 0..1
    reliability: float | None  # r, the median over regions; None without masks


def mask_regions(levels: np.ndarray) -> Tensor | None:
    """Return [M] bool, the regions that are masks, which have a reliability; None if there is none.

    Args:
        levels: [M] i8, -1 for cells of grids.
    """
    mask = levels >= 0
    return torch.from_numpy(mask) if mask.any() else None


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


@one_thread()
def reweighting_factors(
    W: RegionWeights,
    codebook: Codebook,
    progress: Progress = silent,
    *,
    principal: int = DIRECTIONS,
    means: Tensor | None = None,
    threads: int | None = None,
    masks: Tensor | None = None,
    consensus: Tensor | None = None,
    levels: np.ndarray | None = None,
) -> Reweighting:
    """Return the factor of each entry of W, for a scene whose W is in one piece.

    Args:
        W: of all views by rows of codebooks, on the CPU.
        principal: directions in which regions are compared (`RegionDirections`). means: [P, 3] of the splats;
            neighbours are processed together.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
        masks: [M] bool, the regions with a reliability; None: none.
        consensus: [nnz] f32 of each entry (`mask_consensus`).
        levels: [M] i8, the level of each region in its view, -1 for cells of grids; None: one level.
    """
    block = BlockReweighter(W, means, threads, levels)
    directions = RegionDirections.of_weights(W, codebook, principal, threads)
    table = np.zeros((2, codebook.regions + block.levels))

    def add(part: PieceSums) -> None:
        table[:, part.places] += part.values

    factors = block.cosines(directions, masks is not None, add)
    scene = SceneConsistency.of(table, masks, block.level)
    confidence = block.weigh(factors, scene, consensus)
    progress("robust", 1, 1, "steps")
    return Reweighting(factors, confidence, scene.reliability)


def level_numbers(levels: np.ndarray | None, count: int) -> np.ndarray:
    """Return the levels [M] i8 renumbered from 0 on, [M] i32; cells of grids, which have -1, are one level.

    Args:
        levels: None: one level. count: M.
    """
    if levels is None:
        return np.zeros(count, np.int32)
    return np.unique(levels, return_inverse=True)[1].reshape(-1).astype(np.int32)


@dataclass(frozen=True)
class SceneConsistency:
    """Quantities of the whole scene that a step needs, of K levels."""

    mean_cosine: Tensor  # [K] f64, c, the mean cosine
    regions: Tensor  # [M] f32, r_m / r of each region; 1 for regions without a reliability
    power: Tensor  # [K] f64, exponent of the consensus, SHARPNESS (1 - r)
    reliability: float | None  # r, the median over all regions; None without masks

    @classmethod
    def of(cls, sums: np.ndarray, mask: Tensor | None, level: np.ndarray) -> "SceneConsistency":
        """Compute from the sums of `BlockReweighter.cosines` over all splats.

        Args:
            sums: [2, M + K] f64. mask: [M] bool, the regions with a reliability; None: none.
            level: [M] i32, of each region.
        """
        confirmed, totals = torch.from_numpy(sums)
        count = level.size
        mean_cosine = torch.where(totals[count:] > 0, confirmed[count:] / totals[count:], 0.0)
        regions, power = torch.ones(count, dtype=torch.float32), torch.ones(len(mean_cosine), dtype=torch.float64)
        if mask is None:
            return cls(mean_cosine, regions, power, None)
        has_sum = (totals[:count] > 0) & mask
        reliable = torch.where(has_sum, confirmed[:count] / totals[:count], 0.0)
        for number in range(len(mean_cosine)):
            in_level = has_sum & torch.from_numpy(level == number)
            median = float(reliable[in_level].median()) if in_level.any() else 0.0
            power[number] = SHARPNESS * (1.0 - median)
            if median > 0:
                regions = torch.where(in_level, reliable / median, regions.double()).float()
        return cls(mean_cosine, regions, power, float(reliable[has_sum].median()) if has_sum.any() else 0.0)


class BlockReweighter:
    """Cosines, factors and scores of a block of splats that begins at a piece (`liftcore.solve.sums`).

    Args:
        W: of all views by rows of codebooks, on the CPU; a row for each splat of the block.
        means: [n, 3] of these splats; neighbours, which read the same directions, are processed together.
        threads: None uses the cores that this process may use. The result is bitwise identical for any value.
        levels: [M] i8, of each region of the scene, -1 for cells of grids; None: one level.
    """

    def __init__(
        self, W: RegionWeights, means: Tensor | None, threads: int | None, levels: np.ndarray | None = None
    ) -> None:
        self.W, self.threads = W, threads
        self.level = level_numbers(levels, int(W.offsets[-1]))
        self.levels = int(self.level.max(initial=0)) + 1
        self.view = torch.repeat_interleave(W.offsets.diff())
        self.rows = torch.nonzero(W.indptr.diff())[:, 0]
        if means is not None:
            self.rows = self.rows[torch.argsort(morton_codes(means[self.rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)

    def cosines(self, directions: RegionDirections, by_region: bool, add: Callable[[PieceSums], None]) -> Tensor:
        """Return ``c_jm`` of each entry, [nnz] f32.

        Args:
            by_region: True to compute the sums of reliability.
            add: called with the sums of each piece, in order: ``W (1 - p) c`` and ``W (1 - p)`` of each region and,
                at the places from M on, ``W c`` and ``W`` of each level.
        """
        products, squares = self._entries(), self._entries()
        for columns in directions.slices():
            table, width = flat_table(directions.table(columns)), columns.stop - columns.start
            arrays = [self._arrays(), table, width, products.numpy(), squares.numpy()]
            blocks = [(self.rows[first:last].numpy(), *arrays) for first, last in self.blocks]
            run_each(compare_rows, blocks, self.threads)
        arrays = [*self._arrays(), products.numpy(), squares.numpy()]

        def add_rows(first: int, last: int, table: np.ndarray) -> None:
            tally(*[first, last, *arrays, by_region, table])

        shape = 2, int(self.W.offsets[-1]) + self.levels
        for part in piece_sums(add_rows, self.W.indptr.shape[0] - 1, shape, self.threads):
            add(part)
        return products

    def weigh(self, cosines: Tensor, scene: SceneConsistency, consensus: Tensor | None) -> Tensor:
        """Replace cosines by factors ``s ((1 - p) c_jm + p c) (r_m / r) q^power``, in place.

        Args:
            cosines: [nnz] f32, of `cosines`.
            consensus: [nnz] f32 of each entry (`mask_consensus`); None: no consensus.

        Returns:
            [n] f32, the confidence of each splat.
        """
        confidence = torch.zeros(self.W.indptr.shape[0] - 1, dtype=torch.float32)
        consensus = torch.zeros(0, dtype=torch.float32) if consensus is None else consensus  # as the kernel reads it
        parts = cosines, scene.regions, consensus, confidence, scene.mean_cosine, scene.power
        powers = ((np.arange(POWERS + 2) / POWERS) ** scene.power.numpy()[:, None]).astype(np.float32)
        arrays = [*self._arrays(), *(part.numpy() for part in parts), powers]
        # In the order of memory: nothing is shared by neighbours, unlike in `cosines`.
        blocks = [(first, last, *arrays) for first, last in self.W.blocks(BLOCK_ROWS, BLOCK_ENTRIES)]
        run_each(weigh_rows, blocks, self.threads)
        return confidence

    def _entries(self) -> Tensor:
        """Return zeros for the entries of W, [nnz] f32."""
        size = self.W.weight.nbytes
        return zeros(tuple(self.W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)

    def _arrays(self) -> list[np.ndarray]:
        """Return the arrays of W, and the view and level of each region."""
        W = self.W
        return [*(part.numpy() for part in (W.indptr, W.region, W.weight, self.view)), self.level]


@kernel
def weigh_rows(
    first_row, last_row, indptr, region, weight, view, level, cosines, reliable, consensus, confidence,
    mean_cosine, power, powers,
):  # fmt: skip
    """Compute `BlockReweighter.weigh` of rows ``first_row..last_row``.

    Powers of consensus are interpolated in a table [K, n].
    """
    levels = mean_cosine.size
    before, after, gain = np.empty(levels), np.empty(levels), np.empty(levels)
    cosine_sums, view_shares = np.empty(levels), np.empty(levels)
    for row in range(first_row, last_row):
        first, last = indptr[row], indptr[row + 1]
        if first == last:
            continue
        before[:] = after[:] = cosine_sums[:] = 0.0
        for k in range(first, last):
            before[level[region[k]]] += weight[k]
        k = first
        while k < last:
            begin, v = k, view[region[k]]
            view_shares[:] = 0.0
            while k < last and view[region[k]] == v:
                a = level[region[k]]
                view_shares[a] += weight[k] * (1.0 / before[a] if before[a] > 0.0 else 0.0)
                k += 1
            for n in range(begin, k):
                a = level[region[n]]
                share = min(view_shares[a], 1.0)
                scaled = ((1.0 - share) * cosines[n] + share * mean_cosine[a]) * reliable[region[n]]
                if consensus.size > 0:
                    if consensus[n] > STEEP:
                        place = consensus[n] * np.float32(POWERS)
                        i = np.int64(place)
                        scaled *= powers[a, i] + (place - np.float32(i)) * (powers[a, i + 1] - powers[a, i])
                    else:
                        scaled *= consensus[n] ** np.float32(power[a])
                after[a] += weight[n] * scaled
                cosine_sums[a] += weight[n] * scaled * cosines[n]
                cosines[n] = scaled
        total = cosine_total = 0.0
        for a in range(levels):
            gain[a] = before[a] / after[a] if after[a] > 0.0 else 0.0
            total += before[a]
            cosine_total += gain[a] * cosine_sums[a]
        for n in range(first, last):
            a = level[region[n]]
            cosines[n] = cosines[n] * gain[a] if gain[a] > 0.0 else 1.0
        confidence[row] = cosine_total / total if total > 0.0 else 0.0


@kernel
def tally(first, last, indptr, region, weight, view, level, cosines, squares, by_region, sums):
    """Replace products of the entries of some rows by cosines, and add these to the sums [2, M + K] f64."""
    count = level.size
    totals, view_shares = np.empty(sums.shape[1] - count), np.empty(sums.shape[1] - count)
    for row in range(first, last):
        totals[:] = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            totals[level[region[k]]] += weight[k]
        k = indptr[row]
        while k < indptr[row + 1]:
            begin, v = k, view[region[k]]
            view_shares[:] = 0.0
            while k < indptr[row + 1] and view[region[k]] == v:
                length = np.sqrt(squares[k])
                cosine = cosines[k] / length if length > NO_CONSENSUS else np.float32(0.0)
                cosines[k] = min(max(cosine, np.float32(0.0)), np.float32(1.0))
                a = level[region[k]]
                sums[0, count + a] += weight[k] * np.float64(cosines[k])
                sums[1, count + a] += weight[k]
                view_shares[a] += weight[k] * (1.0 / totals[a] if totals[a] > 0.0 else 0.0)
                k += 1
            for n in range(begin, k if by_region else begin):
                other_share = max(1.0 - view_shares[level[region[n]]], 0.0)
                sums[0, region[n]] += weight[n] * other_share * cosines[n]
                sums[1, region[n]] += weight[n] * other_share
