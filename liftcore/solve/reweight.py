"""The robust step on W: each region keeps as much of its weight at a splat as the other views agree with it.

With e_m the direction of region m (`liftcore.solve.directions`), its weight in view v at splat j becomes::

    W'_jm = s_j W_jm ((1 - p_jv) c_jm + p_jv c),     c_jm = max(0, cos(e_m, r_jv))
    r_jv = sum of W_jn e_n over the regions n of all other views,     c = sum W c_jm / sum W over the scene

``p_jv`` is the share of view v in the weight of splat j, and ``s_j`` gives the splat its old sum of weights back, so
denominators, ``seen`` and total weight stay what they were. A further step takes r and p from the weights of the step
before, and starts from the first W again. Nothing is tuned; each part has its reason:

- **The other views judge, never the region itself.** A region's vector is noisy, and the noise of a heavy region
  leans the splat's mean towards itself. Judged by that mean it is rewarded for its own noise, most where few regions
  meet: that, not its bandwidth, is how reweighting by the distance to x_j lost on masks. Regions of one view are left
  out together, for levels and neighbouring cells share their errors.
- **Its own view agrees, with its share.** Without ``p c`` a minority of agreeing views outvotes a view that holds
  most of the weight, and splats that one view sees well turn into what leaks to them in the others. Its own
  agreement counts as what is usual in the scene, c, for the measured one would be the noise again.
- **The cosine itself is the weight.** If ``e_m = a_m x + noise``, the cosine estimates a_m up to a factor, and
  weights in proportion to the signal give the least noise. There is no bandwidth; a region merged of two things
  keeps part of its weight, and one that points away from the others loses it.

**Each level by itself where levels disagree.** A whole and its part may have a vector each, and both are right:
their sum is neither, and things that say the same on two levels would outvote those that do not at every border.
Where masks of parts and wholes say different things (`NodeVectors.levels_disagree`), p, c, r, s and all sums are
taken among the regions of one level, and each level keeps its weight at each splat. Cells of grids are a level.
Levels that say the same are judged together: each is a witness more, which counts where views are few.

A splat of one view does not change. A region without direction (a zero vector, or the mean itself) has c_jm = 0, and
where nothing in the scene has a direction nothing changes.

**Region reliability** asks the same of a region as a whole. What misleads at one splat misleads at all: a wrong word,
a mask of two things. With ``p`` as above, region m of view v has::

    r_m = sum_j W_jm (1 - p_jv) c_jm / sum_j W_jm (1 - p_jv)        r = the median of r_m over the regions

and all its entries get the factor ``r_m / r``. What other views do not see of a region says nothing about it, so the
weights are those of the others. Taken once: a second pass judges by what the first made, and loses again. Cells of a
grid are no claim that all their splats are one thing: those that lie across an edge would lose their say there.

**Mask consensus** (`consensus`) comes in as ``q_jm^(SHARPNESS (1 - r))``: where features agree they tell wrong masks
themselves, and geometry has the more to say the less they do. That exponent is what keeps right masks as they are.

**Confidence** of a splat is the mean of c_jm over its entries, each by its final weight: how far views that do not
know of each other say the same of it. **What its own feature explains** of a splat is the same mean of
``(1 - p) c_jm + p c``: what a splat of one view says is worth what is usual, not nothing.

**How a step splits.** Cosines, factors and scores are functions of a splat's own row of W (`ViewConsistency`, on any
block of splats). Of the scene they take c, r and the r_m: sums over all splats, taken by pieces (`SceneAgreement`).
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

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 11, 1 << 15  # a splat has a sum for each view of it
POWERS = 1 << 12  # of consensus, between which others lie on lines, off by 3e-5 of themselves at most
STEEP = np.float32(1 / 16)  # consensus below which powers under one are no lines there; few have so little
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is what rounding leaves of inputs that cancel
SHARPNESS = 4.0  # the most that costs right masks of no scene more than .001 of accuracy (docs/method.md)


@dataclass(frozen=True)
class Agreement:
    """What reweighting found."""

    factors: Tensor  # [nnz] f32, of each entry of W; the sums of rows stay what they are
    directions: RegionDirections  # by which regions were compared
    confidence: Tensor | None  # [P] f32 in 0..1; None after no step
    explained: Tensor | None  # [P] f32 in 0..1, how well a splat's own feature explains what views say; None likewise
    reliability: float | None = None  # r, the median over regions; None where it was not asked for


def whole_regions(reliability: bool | str, levels: np.ndarray) -> Tensor | None:
    """The regions that are weighted as a whole, [M] bool: with ``auto`` those of masks; None where none is.

    Args:
        reliability: the setting. levels: [M] i8, -1 for cells of grids.
    """
    chosen = levels >= 0 if reliability == "auto" else np.full(levels.shape, bool(reliability))
    return torch.from_numpy(chosen) if chosen.any() else None


def agreement_facts(
    levels: np.ndarray, reliability: float | None, confidence: Tensor | None, levels_apart: bool
) -> dict[str, Any]:
    """What reweighting tells of the scene's features, for the diagnostics.

    Args:
        levels: [M] i8, -1 for cells of grids. confidence: [P] f32.
        levels_apart: whether regions were compared with those of their own level alone.
    """
    facts: dict[str, Any] = {"masks": int((levels >= 0).sum()), "levels_apart": levels_apart}
    if reliability is not None:
        facts["reliability_median"] = reliability
    if confidence is not None:
        facts["confidence_mean"] = float(confidence.numpy().mean(dtype=np.float64))
    return facts


def reweighted(W: RegionWeights, factors: Tensor) -> RegionWeights:
    """W with each entry times its factor [nnz] f32, whose memory its weights take over."""
    return replace(W, weight=torch.mul(W.weight, factors, out=factors))


@one_thread()
def agreement_factors(
    W: RegionWeights,
    codebook: Codebook,
    steps: int,
    progress: Progress = silent,
    *,
    principal: int = DIRECTIONS,
    means: Tensor | None = None,
    threads: int | None = None,
    reliability: Tensor | None = None,
    consensus: Tensor | None = None,
    levels: np.ndarray | None = None,
    on_card: bool = False,
) -> Agreement:
    """What each entry of W is multiplied with after so many steps, for a scene whose W lies in one place.

    Args:
        W: of all views by rows of codebooks, on the CPU or on the device that works.
        principal: directions in which regions are compared (`RegionDirections`). means: [P, 3] of the splats;
            neighbours are judged together.
        threads: None takes the cores that this process may use. The number changes no bit.
        reliability: [M] bool, the regions that have factors as a whole; None: none has.
        consensus: [nnz] f32 of each entry (`mask_consensus`).
        levels: [M] i8, the level of each region in its view, -1 for cells of grids; None: all are of one.
        on_card: work where W lies, by `liftcore.solve.reweight_on_card`.
    """
    if on_card:
        from liftcore.solve.reweight_on_card import ViewConsistencyOnCard

        block: ViewConsistency | ViewConsistencyOnCard = ViewConsistencyOnCard(W, levels)
        directions = RegionDirections(codebook, block.totals(), W.region.shape[0], principal)
    else:
        block = ViewConsistency(W, means, threads, levels)
        directions = RegionDirections.of_weights(W, codebook, principal, threads)
    factors, scores, scene = None, torch.zeros(2, 0, dtype=torch.float32), None
    for step in range(steps):
        table = np.zeros((2, codebook.regions + block.levels))

        def add(part: PieceSums, table: np.ndarray = table) -> None:
            table[:, part.places] += part.values

        cosines = block.cosines(directions, factors, reliability is not None, add)
        scene = SceneAgreement.of(table, reliability, block.level)
        scores = block.weigh(cosines, factors, scene, consensus)
        factors = cosines
        progress("robust", step + 1, steps, "steps")
    if factors is None or scene is None:
        return Agreement(torch.ones_like(W.weight), directions, None, None)
    return Agreement(factors, directions, scores[0], scores[1], scene.reliability)


def level_numbers(levels: np.ndarray | None, count: int) -> np.ndarray:
    """[M] i32: the levels [M] i8 that there are, numbered from 0 on; cells of grids, which have -1, are one.

    Args:
        levels: None: all regions are of one. count: M.
    """
    if levels is None:
        return np.zeros(count, np.int32)
    return np.unique(levels, return_inverse=True)[1].reshape(-1).astype(np.int32)


@dataclass(frozen=True)
class SceneAgreement:
    """What a step takes from the whole scene, of K levels."""

    usual: Tensor  # [K] f64, c, the mean cosine
    regions: Tensor  # [M] f32, r_m / r of each region; one where it has no factor as a whole
    power: Tensor  # [K] f64, of the consensus, SHARPNESS (1 - r)
    reliability: float | None  # r, the median over all regions; None where it was not asked for

    @classmethod
    def of(cls, sums: np.ndarray, whole: Tensor | None, level: np.ndarray) -> "SceneAgreement":
        """From the sums of `ViewConsistency.cosines` over all splats.

        Args:
            sums: [2, M + K] f64. whole: [M] bool, the regions that have factors as a whole; None: none has.
            level: [M] i32, of each region.
        """
        confirmed, everything = torch.from_numpy(sums)
        count = level.size
        usual = torch.where(everything[count:] > 0, confirmed[count:] / everything[count:], 0.0)
        regions, power = torch.ones(count, dtype=torch.float32), torch.ones(len(usual), dtype=torch.float64)
        if whole is None:
            return cls(usual, regions, power, None)
        has_sum = (everything[:count] > 0) & whole
        reliable = torch.where(has_sum, confirmed[:count] / everything[:count], 0.0)
        for number in range(len(usual)):
            own = has_sum & torch.from_numpy(level == number)
            median = float(reliable[own].median()) if own.any() else 0.0
            power[number] = SHARPNESS * (1.0 - median)
            if median > 0:
                regions = torch.where(own, reliable / median, regions.double()).float()
        return cls(usual, regions, power, float(reliable[has_sum].median()) if has_sum.any() else 0.0)


class ViewConsistency:
    """A step's work on a block of splats, which begins at a piece (`liftcore.solve.sums`): no other splat is needed.

    Args:
        W: of all views by rows of codebooks, on the CPU; a row for each splat of the block.
        means: [n, 3] of these splats; neighbours, which read the same directions, are judged together.
        threads: None takes the cores that this process may use. The result is bitwise identical for any value.
        levels: [M] i8, of each region of the scene, -1 for cells of grids; None: all are of one.
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

    def cosines(
        self,
        directions: RegionDirections,
        factors: Tensor | None,
        by_region: bool,
        add: Callable[[PieceSums], None],
    ) -> Tensor:
        """``c_jm`` of each entry, [nnz] f32.

        Args:
            factors: [nnz] f32, of the step before; None before the first one.
            by_region: whether reliability is asked for.
            add: called with the sums of each piece, in their order: ``W (1 - p) c`` and ``W (1 - p)`` of each region
                and, at the places from M on, ``W c`` and ``W`` of each level.
        """
        found, squares, factors = self._entries(), self._entries(), _or_ones(factors)
        for columns in directions.slices():
            table, width = flat_table(directions.table(columns)), columns.stop - columns.start
            arrays = [self._arrays(factors), table, width, found.numpy(), squares.numpy()]
            blocks = [(self.rows[first:last].numpy(), *arrays) for first, last in self.blocks]
            run_each(compare_rows, blocks, self.threads)
        arrays = [*self._arrays(factors), found.numpy(), squares.numpy()]

        def summed(first: int, last: int, table: np.ndarray) -> None:
            tally(*[first, last, *arrays, by_region, table])

        shape = 2, int(self.W.offsets[-1]) + self.levels
        for part in piece_sums(summed, self.W.indptr.shape[0] - 1, shape, self.threads):
            add(part)
        return found

    def weigh(
        self, cosines: Tensor, factors: Tensor | None, scene: SceneAgreement, consensus: Tensor | None
    ) -> Tensor:
        """Cosines become factors ``s ((1 - p) c_jm + p c) (r_m / r) q^power``, in place.

        Args:
            cosines: [nnz] f32, as `cosines` gives them. factors: of the step before, as there.
            consensus: [nnz] f32 of each entry (`mask_consensus`); None: there is none.

        Returns:
            [2, n] f32: the confidence of each splat, and how well its own feature explains what views say of it.
        """
        scores = torch.zeros(2, self.W.indptr.shape[0] - 1, dtype=torch.float32)
        parts = cosines, scene.regions, _or_ones(consensus), scores, scene.usual, scene.power
        powers = ((np.arange(POWERS + 2) / POWERS) ** scene.power.numpy()[:, None]).astype(np.float32)
        arrays = [*self._arrays(_or_ones(factors)), *(part.numpy() for part in parts), powers]
        blocks = [(self.rows[first:last].numpy(), *arrays) for first, last in self.blocks]
        run_each(weigh_rows, blocks, self.threads)
        return scores

    def _entries(self) -> Tensor:
        """Zeros for the entries of W, [nnz] f32."""
        size = self.W.weight.nbytes
        return zeros(tuple(self.W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)

    def _arrays(self, factors: Tensor) -> list[np.ndarray]:
        """W with its factors, and the view and the level of each region."""
        W = self.W
        return [*(part.numpy() for part in (W.indptr, W.region, W.weight, factors, self.view)), self.level]


def _or_ones(factors: Tensor | None) -> Tensor:
    """Factors or consensus [nnz] f32 for a kernel, which takes none [0] for ones."""
    return torch.zeros(0, dtype=torch.float32) if factors is None else factors


@kernel
def weigh_rows(
    rows, indptr, region, weight, factors, view, level, cosines, reliable, consensus, scores, usual, power, powers
):  # fmt: skip
    """`ViewConsistency.weigh` of some rows. Powers of consensus lie on lines between those of a table [K, n]."""
    levels = usual.size
    before, after, gain = np.empty(levels), np.empty(levels), np.empty(levels)
    confirmed, explained, own = np.empty(levels), np.empty(levels), np.empty(levels)
    for row in rows:
        first, last = indptr[row], indptr[row + 1]
        before[:] = after[:] = confirmed[:] = explained[:] = 0.0
        for k in range(first, last):
            before[level[region[k]]] += weight[k]
        k = first
        while k < last:
            begin, v = k, view[region[k]]
            own[:] = 0.0
            while k < last and view[region[k]] == v:
                factor, a = factors[k] if factors.size > 0 else np.float32(1.0), level[region[k]]
                own[a] += weight[k] * factor * (1.0 / before[a] if before[a] > 0.0 else 0.0)
                k += 1
            for n in range(begin, k):
                a = level[region[n]]
                share = min(own[a], 1.0)
                said = (1.0 - share) * cosines[n] + share * usual[a]
                kept = said * reliable[region[n]]
                if consensus.size > 0:
                    if consensus[n] > STEEP:
                        place = consensus[n] * np.float32(POWERS)
                        i = np.int64(place)
                        kept *= powers[a, i] + (place - np.float32(i)) * (powers[a, i + 1] - powers[a, i])
                    else:
                        kept *= consensus[n] ** np.float32(power[a])
                after[a] += weight[n] * kept
                confirmed[a] += weight[n] * kept * cosines[n]
                explained[a] += weight[n] * kept * said
                cosines[n] = kept
        whole = right = like = 0.0
        for a in range(levels):
            gain[a] = before[a] / after[a] if after[a] > 0.0 else 0.0
            whole += before[a]
            right += gain[a] * confirmed[a]
            like += gain[a] * explained[a] if after[a] > 0.0 else before[a] * usual[a]
        for n in range(first, last):
            a = level[region[n]]
            cosines[n] = cosines[n] * gain[a] if gain[a] > 0.0 else 1.0
        scores[0, row] = right / whole if whole > 0.0 else 0.0
        scores[1, row] = like / whole if whole > 0.0 else usual[0]


@kernel
def tally(first, last, indptr, region, weight, factors, view, level, cosines, squares, by_region, sums):
    """Products and squares of the entries of some rows become cosines, and their sums [2, M + K] f64 are taken."""
    count = level.size
    totals, own = np.empty(sums.shape[1] - count), np.empty(sums.shape[1] - count)
    for row in range(first, last):
        totals[:] = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            totals[level[region[k]]] += weight[k]
        k = indptr[row]
        while k < indptr[row + 1]:
            begin, v = k, view[region[k]]
            own[:] = 0.0
            while k < indptr[row + 1] and view[region[k]] == v:
                length, factor = np.sqrt(squares[k]), factors[k] if factors.size > 0 else np.float32(1.0)
                cosine = cosines[k] / length if length > NO_CONSENSUS else np.float32(0.0)
                cosines[k] = min(max(cosine, np.float32(0.0)), np.float32(1.0))
                a = level[region[k]]
                sums[0, count + a] += weight[k] * np.float64(cosines[k])
                sums[1, count + a] += weight[k]
                own[a] += weight[k] * factor * (1.0 / totals[a] if totals[a] > 0.0 else 0.0)
                k += 1
            for n in range(begin, k if by_region else begin):
                others = max(1.0 - own[level[region[n]]], 0.0)
                factor = factors[n] if factors.size > 0 else np.float32(1.0)
                sums[0, region[n]] += weight[n] * factor * others * cosines[n]
                sums[1, region[n]] += weight[n] * factor * others
