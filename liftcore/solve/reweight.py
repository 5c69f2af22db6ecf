"""The robust step on W: each region keeps as much of its weight at a splat as the other views agree with it.

With e_m the direction of region m (`liftcore.solve.directions`), its weight in view v at splat j becomes::

    W'_jm = s_j W_jm ((1 - p_jv) c_jm + p_jv c),     c_jm = max(0, cos(e_m, r_jv))
    r_jv = sum of W_jn e_n over the regions n of all other views,     c = sum W c_jm / sum W over the scene

``p_jv`` is the share of view v in the weight of splat j, and ``s_j`` gives the splat its old sum of weights back, so
denominators, ``seen`` and evidence stay what they were. A further step takes r and p from the weights of the step
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
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from liftcore.jit import kernel, vectorised
from liftcore.one_thread import one_thread
from liftcore.progress import Progress, silent
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.codebook import Codebook
from liftcore.solve.directions import RegionDirections
from liftcore.solve.memory import zeros
from liftcore.solve.weights import MEMORY_LIMIT, RegionWeights, row_blocks, run_each

BLOCK_ROWS, BLOCK_ENTRIES = 1 << 11, 1 << 15  # a splat has a sum for each view of it
LONG = 256  # terms of a sum that float32 adds up one by one
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


def reweighted(W: RegionWeights, factors: Tensor) -> RegionWeights:
    """W with each entry times its factor [nnz] f32."""
    return replace(W, weight=torch.mul(W.weight, factors, out=factors))


@one_thread()
def agreement_factors(
    W: RegionWeights,
    codebook: Codebook,
    steps: int,
    progress: Progress = silent,
    *,
    means: Tensor | None = None,
    threads: int | None = None,
    reliability: Tensor | None = None,
    consensus: Tensor | None = None,
) -> Agreement:
    """What each entry of W is multiplied with after so many steps.

    Args:
        W: of all views by rows of codebooks, on the CPU. means: [P, 3] of the splats; neighbours are judged together.
        threads: None takes the cores that this process may use. The number changes no bit.
        reliability: [M] bool, the regions that have factors as a whole; None: none has.
        consensus: [nnz] f32 of each entry (`mask_consensus`).
    """
    judge = _Judge(W, codebook, means, threads, reliability, consensus)
    factors = judge.array()
    factors += 1.0
    for step in range(steps):
        factors = judge.step(factors)
        progress("robust", step + 1, steps, "steps")
    confidence, explained = judge.told if steps else (None, None)
    return Agreement(factors, judge.directions, confidence, explained, judge.median)


class _Judge:
    """What all steps share: the sums of rows and the directions of regions."""

    def __init__(
        self,
        W: RegionWeights,
        codebook: Codebook,
        means: Tensor | None,
        threads: int | None,
        reliability: Tensor | None,
        consensus: Tensor | None,
    ) -> None:
        self.W, self.threads = W, threads
        self.reliability, self.consensus = reliability, consensus
        self.regions, self.power, self.median = torch.ones(codebook.regions), 1.0, None
        self.told = torch.zeros(2, W.splats.shape[0])
        sums = W.row_sums()
        self.inverse = torch.where(sums > 0, 1.0 / sums, 0.0)
        self.view = torch.repeat_interleave(W.offsets.diff())
        self.rows = torch.nonzero(W.indptr.diff())[:, 0]
        if means is not None:
            self.rows = self.rows[torch.argsort(morton_codes(means[self.rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
        self.directions = RegionDirections(W, codebook)

    def array(self) -> Tensor:
        """Zeros for the entries of W, [nnz] f32."""
        size = self.W.weight.nbytes
        return zeros(tuple(self.W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)

    def step(self, factors: Tensor) -> Tensor:
        """The factors after a step from those before it."""
        W, found, squares = self.W, self.array(), self.array()
        for columns in self.directions.slices():
            table = self.directions.table(columns)
            blocks = [(first, last, factors, table, found, squares) for first, last in self.blocks]
            run_each(self._compare, blocks, self.threads)
        everything = agreeing = 0.0
        for first in range(0, found.shape[0], BLOCK_ENTRIES << 5):
            own = slice(first, first + (BLOCK_ENTRIES << 5))
            lengths = squares[own].sqrt_()
            cosines = torch.where(lengths > NO_CONSENSUS, found[own] / lengths, 0.0).clamp_(0.0, 1.0)
            found[own] = cosines
            agreeing += float((W.weight[own].double() * cosines).sum())
            everything += float(W.weight[own].sum(dtype=torch.float64))
        del squares
        usual = agreeing / (everything or 1.0)
        if self.reliability is not None:
            self._rely(factors, found, self.reliability)
        run_each(self._weigh, [(first, last, factors, usual, found) for first, last in self.blocks], self.threads)
        return found

    def _compare(
        self, first: int, last: int, factors: Tensor, table: Tensor, products: Tensor, squares: Tensor
    ) -> None:
        """Add ``e_m . r_jv`` and ``|r_jv|^2`` of the entries of some rows, over the channels of the table."""
        arrays = (self.inverse, self.view, table, products, squares)
        compare_rows(*self._entries(first, last, factors), *(part.numpy() for part in arrays))

    def _weigh(self, first: int, last: int, factors: Tensor, usual: float, found: Tensor) -> None:
        """Cosines of some rows become their factors ``s ((1 - p) c_m + p c) (r_m / r) q^power``."""
        consensus = torch.zeros(0) if self.consensus is None else self.consensus
        arrays = (self.inverse, self.view, found, self.regions, consensus, self.told)
        numbers = usual, self.power
        weigh_rows(*[*self._entries(first, last, factors), *(part.numpy() for part in arrays), *numbers])

    def _entries(self, first: int, last: int, factors: Tensor) -> list[np.ndarray]:
        """Some rows, and W with its factors."""
        W = self.W
        return [part.numpy() for part in (self.rows[first:last], W.indptr, W.region, W.weight, factors)]

    def _rely(self, factors: Tensor, cosines: Tensor, whole: Tensor) -> None:
        """The factors of regions as a whole [M] bool, and how sharp the consensus is to be."""
        W, sums = self.W, torch.zeros(2, self.regions.shape[0], dtype=torch.float64)
        arrays = (W.indptr, W.region, W.weight, factors, cosines, self.inverse, self.view, sums)
        tally(*(part.numpy() for part in arrays))
        known = (sums[1] > 0) & whole
        reliable = torch.where(known, sums[0] / sums[1], 0.0)
        self.median = float(reliable[known].median()) if known.any() else 0.0
        if self.median > 0:
            self.regions = torch.where(known, reliable / self.median, 1.0).float()
        self.power = SHARPNESS * (1.0 - self.median)


@vectorised
def compare_rows(rows, indptr, region, weight, factors, inverse, view, table, products, squares):
    """`_Judge._compare` of some rows.

    The sum of the others is that of the views before and that of the views behind: a difference of two float32 sums
    would be mostly rounding where a view has most of the weight. Of a view float32 adds up LONG entries one by one.
    """
    width, most = table.shape[1], 0
    for row in rows:
        most = max(most, indptr[row + 1] - indptr[row])
    most = min(most, view[-1] + 1)
    said, before = np.empty((most + 1, width), np.float32), np.empty((most + 1, width), np.float32)
    behind, others = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in rows:
        first, last = indptr[row], indptr[row + 1]
        before[0] = behind[:] = 0.0
        k, number = first, 0
        while k < last:
            begin, v = k, view[region[k]]
            while k < last and view[region[k]] == v:
                target = number if k - begin < LONG else most
                said[target] = 0.0
                for n in range(k, min(k + LONG, last)):
                    m = region[n]
                    if view[m] != v:
                        break
                    share = np.float32(weight[n] * factors[n] * inverse[row])
                    for c in range(width):
                        said[target, c] += share * table[m, c]
                    k += 1
                if target != number:
                    for c in range(width):
                        said[number, c] += said[target, c]
            for c in range(width):
                before[number + 1, c] = before[number, c] + said[number, c]
            number += 1
        k = last - 1
        while k >= first:
            number -= 1
            v, square = view[region[k]], np.float32(0.0)
            for c in range(width):
                others[c] = before[number, c] + behind[c]
                square += others[c] * others[c]
                behind[c] += said[number, c]
            while k >= first and view[region[k]] == v:
                m, product = region[k], np.float32(0.0)
                for c in range(width):
                    product += table[m, c] * others[c]
                products[k] += product
                squares[k] += square
                k -= 1


@kernel
def weigh_rows(
    rows, indptr, region, weight, factors, inverse, view, cosines, reliable, consensus, told, usual, power
):
    """`_Judge._weigh` of some rows, and what views say of them: confidence, and what their own feature explains."""
    sharp = np.float32(power)
    for row in rows:
        first, last = indptr[row], indptr[row + 1]
        before, after, confirmed, explained = 0.0, 0.0, 0.0, 0.0
        k = first
        while k < last:
            begin, v, own = k, view[region[k]], 0.0
            while k < last and view[region[k]] == v:
                own += weight[k] * factors[k] * inverse[row]
                k += 1
            own = min(own, 1.0)
            for n in range(begin, k):
                said = (1.0 - own) * cosines[n] + own * usual
                kept = said * reliable[region[n]]
                if consensus.size > 0:
                    kept *= consensus[n] ** sharp
                before += weight[n]
                after += weight[n] * kept
                confirmed += weight[n] * kept * cosines[n]
                explained += weight[n] * kept * said
                cosines[n] = kept
        gain = before / after if after > 0.0 else 0.0
        for n in range(first, last):
            cosines[n] = cosines[n] * gain if gain > 0.0 else 1.0
        told[0, row] = confirmed / after if after > 0.0 else 0.0
        told[1, row] = explained / after if after > 0.0 else usual


@kernel
def tally(indptr, region, weight, factors, cosines, inverse, view, sums):
    """Of each region, what the splats' other views say of it, ``W (1 - p) c``, and ``W (1 - p)``: sums [2, M] f64."""
    for row in range(indptr.shape[0] - 1):
        k = indptr[row]
        while k < indptr[row + 1]:
            begin, v, own = k, view[region[k]], 0.0
            while k < indptr[row + 1] and view[region[k]] == v:
                own += weight[k] * factors[k] * inverse[row]
                k += 1
            others = max(1.0 - own, 0.0)
            for n in range(begin, k):
                sums[0, region[n]] += weight[n] * factors[n] * others * cosines[n]
                sums[1, region[n]] += weight[n] * factors[n] * others
