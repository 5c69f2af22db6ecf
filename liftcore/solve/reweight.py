"""The robust step on W: each region keeps as much of its weight at a splat as the other views agree with it.

With u_m the unit vector of region m, ``mu = sum W u / sum W`` the scene's mean over all splats and views, and
``e_m = (u_m - mu) / |u_m - mu|``, the weight of region m of view v at splat j becomes::

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
- **Centred on the scene's mean**, as the vectors of CLIP lie in one narrow cone: raw cosines are all alike.
- **The cosine itself is the weight.** If ``e_m = a_m x + noise``, the cosine estimates a_m up to a factor, and
  weights in proportion to the signal give the least noise. There is no bandwidth; a region merged of two things
  keeps part of its weight, and one that points away from the others loses it.

A splat of one view does not change. A region without direction (a zero vector, or the mean itself) has c_jm = 0, and
where nothing in the scene has a direction nothing changes.
"""

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from liftcore.one_thread import one_thread
from liftcore.progress import Progress, silent
from liftcore.solve.closed_form import bag_sums, morton_codes
from liftcore.solve.codebook import Codebook
from liftcore.solve.memory import zeros
from liftcore.solve.weights import MEMORY_LIMIT, RegionWeights, row_blocks, run_each, segment_sums

ROWS = 1 << 14  # of a table in float64 at a time
BLOCK_ROWS, BLOCK_ENTRIES = 1 << 11, 1 << 15  # a splat has a sum for each view of it
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is what rounding leaves of inputs that cancel
NO_DIRECTION = 1e-6  # a unit vector nearer to the mean than that is the mean


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
) -> Tensor:
    """What each entry of W is multiplied with after so many steps, [nnz] f32; the sums of rows stay what they are.

    Args:
        W: of all views by rows of codebooks, on the CPU. means: [P, 3] of the splats; neighbours are judged together.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    judge = _Judge(W, codebook, means, threads)
    factors = judge.array()
    factors += 1.0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        for step in range(steps):
            factors = judge.step(factors)
            progress("robust", step + 1, steps, "steps")
    return factors


class _Judge:
    """What all steps share: the sums of rows and the directions of regions."""

    def __init__(self, W: RegionWeights, codebook: Codebook, means: Tensor | None, threads: int | None) -> None:
        self.W, self.codebook, self.threads = W, codebook, threads
        self.sums = W.row_sums()
        self.rows = torch.nonzero(W.indptr.diff())[:, 0]
        if means is not None:
            self.rows = self.rows[torch.argsort(morton_codes(means[self.rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
        self.mean, self.distances = self._directions()

    def array(self) -> Tensor:
        """Zeros for the entries of W, [nnz] f32."""
        size = self.W.weight.nbytes
        return zeros(tuple(self.W.weight.shape), torch.float32, name="weights", in_file=2 * size > MEMORY_LIMIT)

    def _directions(self) -> tuple[Tensor, Tensor]:
        """The scene's mean of unit vectors [F] f64, and the distance of each region's from it [M] f64."""
        totals = torch.zeros(self.codebook.regions, dtype=torch.float64)
        for first in range(0, self.W.region.shape[0], BLOCK_ENTRIES << 5):
            own = slice(first, first + (BLOCK_ENTRIES << 5))
            totals.index_add_(0, self.W.region[own], self.W.weight[own].double())
        known = torch.cat(self.codebook.lengths) > 0
        whole = float(totals[known].sum()) or 1.0
        mean, squares = torch.zeros(self.codebook.channels, dtype=torch.float64), torch.zeros_like(totals)
        for channels in self.codebook.slices():
            unit = self.codebook.unit_values(channels, torch.device("cpu"))
            for part, own in zip(unit.split(ROWS), totals.split(ROWS), strict=True):
                mean[channels] += own @ part.double() / whole
            for part, squared in zip(unit.split(ROWS), squares.split(ROWS), strict=True):
                squared.add_((part.double() - mean[channels]).square().sum(dim=1))
        distances = squares.sqrt()
        return mean, torch.where((distances > NO_DIRECTION) & known, distances, 0.0)

    def _table(self, channels: slice) -> Tensor:
        """Some channels of e of all regions, [M, C] f32; zeros where a region has no direction."""
        table = self.codebook.unit_values(channels, torch.device("cpu"))
        inverse = torch.where(self.distances > 0, 1.0 / self.distances, 0.0)
        for part, own in zip(table.split(ROWS), inverse.split(ROWS), strict=True):
            part.copy_((part.double() - self.mean[channels]) * own[:, None])
        return table

    def step(self, factors: Tensor) -> Tensor:
        """The factors after a step from those before it."""
        W, found, squares = self.W, self.array(), self.array()
        slices = list(self.codebook.slices())
        for channels in slices:
            table = self._table(channels)
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
        run_each(self._weigh, [(first, last, factors, usual, found) for first, last in self.blocks], self.threads)
        return found

    def _taken(self, first: int, last: int, factors: Tensor) -> tuple[Tensor, ...]:
        """Some rows: where they begin, their entries in W and the regions of these, what each entry is of its row
        now [n] f32, and the runs: where they begin, and the row of each (`RegionWeights.runs`)."""
        rows = self.rows[first:last]
        starts, entries = self.W.take(rows)
        region = self.W.region.index_select(0, entries)
        sums = self.sums[rows].repeat_interleave(starts.diff())
        now = self.W.weight.index_select(0, entries).double() * factors.index_select(0, entries)
        shares = torch.where(sums > 0, now / sums, 0.0).float()
        return starts, entries, region, shares, *self.W.runs(starts, region)

    def _compare(
        self, first: int, last: int, factors: Tensor, table: Tensor, products: Tensor, squares: Tensor
    ) -> None:
        """Add ``e_m . r_jv`` and ``|r_jv|^2`` of the entries of some rows, over the channels of the table."""
        _, entries, region, shares, runs, row = self._taken(first, last, factors)
        own, every = bag_sums(region, table, runs, shares), torch.arange(row.shape[0])
        of_rows = torch.searchsorted(row, torch.arange(last - first + 1))
        others = bag_sums(every, own, of_rows)[row] - own
        nothing, shape = torch.zeros(region.shape[0]), (row.shape[0], table.shape[0])
        pattern = torch.sparse_csr_tensor(runs, region.long(), nothing, size=shape, check_invariants=False)
        products.scatter_add_(0, entries, torch.sparse.sampled_addmm(pattern, others, table.T, beta=0.0).values())
        lengths = torch.linalg.vector_norm(others, dim=1).square()
        squares.scatter_add_(0, entries, lengths.repeat_interleave(runs.diff()))

    def _weigh(self, first: int, last: int, factors: Tensor, usual: float, found: Tensor) -> None:
        """Cosines of some rows become their factors ``s ((1 - p) c_m + p c)``."""
        starts, entries, _, shares, runs, _ = self._taken(first, last, factors)
        own = segment_sums(shares, runs).clamp_(0.0, 1.0).repeat_interleave(runs.diff())
        weights = self.W.weight.index_select(0, entries).double()
        kept = (1.0 - own) * found.index_select(0, entries) + own * usual
        before, after = segment_sums(weights, starts), segment_sums(weights * kept, starts)
        gain = torch.where(after > 0, before / after, 0.0).repeat_interleave(starts.diff())
        found.scatter_(0, entries, torch.where(gain > 0, kept * gain, 1.0).float())
