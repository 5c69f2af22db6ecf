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
masks of parts and wholes differ (`NodeVectors.levels_disagree`), the step runs once a level, with W of this level
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


@dataclass(frozen=True)
class SceneConsistency:
    """Quantities of the whole scene that a step needs."""

    mean_cosine: float  # c
    regions: Tensor  # [M] f32, r_m / r of each region; 1 for regions without a reliability
    power: float  # exponent of the consensus, SHARPNESS (1 - r)

    @classmethod
    def of(cls, sums: np.ndarray, mask: Tensor | None) -> "SceneConsistency":
        """Compute from the sums of `BlockReweighter.cosines` over all splats.

        Args:
            sums: [2, M + 1] f64. mask: [M] bool, the regions with a reliability; None: none.
        """
        confirmed, total = sums[:, -1]
        mean_cosine = float(confirmed / total) if total > 0 else 0.0
        regions = torch.ones(sums.shape[1] - 1, dtype=torch.float32)
        if mask is None:
            return cls(mean_cosine, regions, 1.0)
        has_sum, reliable = _reliabilities(sums[:, :-1], mask)
        median = median_reliability(sums[:, :-1], mask) or 0.0
        if median > 0:
            regions = torch.where(has_sum, reliable / median, regions.double()).float()
        return cls(mean_cosine, regions, SHARPNESS * (1.0 - median))


def _reliabilities(sums: np.ndarray, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the regions of a mask that other views see, [M] bool, and r_m [M] f64, zero for others."""
    confirmed, totals = torch.from_numpy(np.ascontiguousarray(sums))
    has_sum = (totals > 0) & mask
    return has_sum, torch.where(has_sum, confirmed / totals, 0.0)


def median_reliability(sums: np.ndarray, mask: Tensor | None) -> float | None:
    """Return r, the median over the regions [M] of a mask that other views see; None if there is none."""
    if mask is None:
        return None
    has_sum, reliable = _reliabilities(sums, mask)
    return float(reliable[has_sum].median()) if has_sum.any() else None


class BlockReweighter:
    """Cosines, factors and scores of a block of splats that begins at a piece (`liftcore.solve.sums`).

    Args:
        W: of all views by rows of codebooks, on the CPU; a row for each splat of the block.
        means: [n, 3] of these splats; neighbours, which read the same directions, are processed together.
    """

    def __init__(self, W: RegionWeights, means: Tensor | None, threads: int | None) -> None:
        self.W, self.threads = W, threads
        self.view = torch.repeat_interleave(W.offsets.diff())
        self.rows = torch.nonzero(W.indptr.diff())[:, 0]
        if means is not None:
            self.rows = self.rows[torch.argsort(morton_codes(means[self.rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of the sums of `cosines`, [2, M + 1]."""
        return 2, int(self.W.offsets[-1]) + 1

    def cosines(self, directions: RegionDirections, by_region: bool) -> tuple[Tensor, Iterator[PieceSums]]:
        """Return ``c_jm`` of each entry, [nnz] f32, complete once the sums are read.

        Args:
            by_region: True to compute the sums of reliability.

        Returns:
            The cosines and the sums of each piece: ``W (1 - p) c`` and ``W (1 - p)`` of each region and, at place M,
            ``W c`` and ``W``.
        """
        products, squares = self._entries(), self._entries()
        for columns in directions.slices():
            table, width = flat_table(directions.table(columns)), columns.stop - columns.start
            arrays = [*self._arrays(), table, width, products.numpy(), squares.numpy()]
            blocks = [(self.rows[first:last].numpy(), *arrays) for first, last in self.blocks]
            run_each(compare_rows, blocks, self.threads)
        arrays = [*self._arrays(), products.numpy(), squares.numpy()]

        def add_rows(first: int, last: int, table: np.ndarray) -> None:
            tally(*[first, last, *arrays, by_region, table])

        return products, piece_sums(add_rows, self.W.indptr.shape[0] - 1, self.shape, self.threads)

    def weigh(self, cosines: Tensor, scene: SceneConsistency, consensus: Tensor | None, scores: np.ndarray) -> None:
        """Replace cosines by factors ``s ((1 - p) c_jm + p c) (r_m / r) q^power``, in place.

        Args:
            cosines: [nnz] f32, of `cosines`.
            consensus: [nnz] f32 of each entry (`liftcore.solve.consensus`); None: no consensus.
            scores: [2, n] f64, to which ``sum W' c_jm`` and ``sum W`` of each splat are added.
        """
        consensus = torch.zeros(0, dtype=torch.float32) if consensus is None else consensus  # as the kernel reads it
        powers = ((np.arange(POWERS + 2) / POWERS) ** scene.power).astype(np.float32)
        parts = [part.numpy() for part in (cosines, scene.regions, consensus)]
        arrays = [*self._arrays(), *parts, scores, scene.mean_cosine, scene.power, powers]
        # In the order of memory: nothing is shared by neighbours, unlike in `cosines`.
        blocks = [(first, last, *arrays) for first, last in self.W.blocks(BLOCK_ROWS, BLOCK_ENTRIES)]
        run_each(weigh_rows, blocks, self.threads)

    def _entries(self) -> Tensor:
        """Return zeros for the entries of W, [nnz] f32."""
        size = self.W.weight.nbytes
        return zeros(tuple(self.W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)

    def _arrays(self) -> list[np.ndarray]:
        """Return the arrays of W, and the view of each region."""
        return [part.numpy() for part in (self.W.indptr, self.W.region, self.W.weight, self.view)]


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
    reliable,
    consensus,
    scores,
    mean_cosine,
    power,
    powers,
):
    """Compute `BlockReweighter.weigh` of rows ``first_row..last_row``.

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
def tally(first, last, indptr, region, weight, view, cosines, squares, by_region, sums):
    """Replace products of the entries of some rows by cosines, and add these to the sums [2, M + 1] f64."""
    places = sums.shape[1] - 1
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
                sums[0, places] += weight[k] * np.float64(cosines[k])
                sums[1, places] += weight[k]
                view_share += weight[k] * inverse
                k += 1
            other_share = max(1.0 - view_share, 0.0)
            for n in range(begin, k if by_region else begin):
                sums[0, region[n]] += weight[n] * other_share * cosines[n]
                sums[1, region[n]] += weight[n] * other_share


def of_regions(W: RegionWeights, regions: np.ndarray) -> tuple[RegionWeights, Tensor]:
    """Return W with the entries of some regions [M] bool alone, and the indices of these entries [n] i64."""
    indptr, region = W.indptr.numpy(), W.region.numpy()
    starts, entries = np.zeros_like(indptr), np.empty(np.count_nonzero(regions[region]), np.int64)
    list_entries(indptr, region, regions, starts, entries)
    index = torch.from_numpy(entries)
    return replace(W, indptr=torch.from_numpy(starts), region=W.region[index], weight=W.weight[index]), index


@kernel
def list_entries(indptr, region, regions, starts, entries):
    """List the entries of some regions [M] bool, and where those of each row begin."""
    at = 0
    for row in range(indptr.size - 1):
        for k in range(indptr[row], indptr[row + 1]):
            if regions[region[k]]:
                entries[at] = k
                at += 1
        starts[row + 1] = at
