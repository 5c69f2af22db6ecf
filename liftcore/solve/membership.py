"""Memberships: which regions of a view each splat belongs to. Mask consensus and objects ask it alike.

Splat j belongs to region m where m has at least BELONGS of the splat's weight in its group, a level of a view, and
the group weighs more than FAINT there. A splat may lie in a region and not belong to it: on the border of two regions
it belongs to neither.

**How a step splits.** A membership is a function of the splat's weights in one view: blocks of splats and blocks of
views give the same.
"""

from dataclasses import dataclass

import numpy as np

from liftcore.runtime.jit import kernel
from liftcore.values.region_weights import RegionWeights, run_each

BELONGS = 0.7  # of a splat's weight in a level of a view: less, and the splat lies on the border of two regions
FAINT = 0.05  # of rays; a level that weighs less at a splat hardly sees it


@dataclass(frozen=True)
class RegionGroups:
    """The view and the group of each region of all views. Cells of grids are in no group, and take no part."""

    views: int  # V
    view: np.ndarray  # [M] i32
    group: np.ndarray  # [M] i32, view * levels + level; -1 for cells of grids
    levels: int  # that any view has, at least one

    @classmethod
    def of(cls, offsets: np.ndarray, levels: np.ndarray) -> "RegionGroups":
        """From the first region of each view [V + 1] i64, and the level of each region [M] i8, -1 for cells."""
        view = np.repeat(np.arange(offsets.size - 1), np.diff(offsets)).astype(np.int32)
        several = int(levels.max(initial=0)) + 1
        return cls(
            offsets.size - 1, view, np.where(levels < 0, -1, view * several + levels).astype(np.int32), several
        )


@dataclass(frozen=True)
class Memberships:
    """Who belongs to what, of some splats and of some views or all."""

    own: np.ndarray  # [nnz] bool, the entries of W whose splat belongs to their region
    totals: np.ndarray  # [n] f64, the sum of each row of W: t_j where W is of all views


def memberships(W: RegionWeights, groups: RegionGroups, threads: int | None = None) -> Memberships:
    """The memberships of some splats.

    Args:
        W: of views by rows of codebooks, on the CPU; its regions have the numbers of the groups.
        threads: None takes the cores that this process may use. The result is bitwise identical for any value.
    """
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    found = Memberships(np.zeros(region.size, np.bool_), np.zeros(indptr.size - 1))
    arrays = indptr, region, weight, groups.view, groups.group, groups.levels, found.own, found.totals
    run_each(lambda first, last: belong(first, last, *arrays), W.blocks(1 << 16, 1 << 18), threads)
    return found


@kernel
def belong(first, last, indptr, region, weight, view, group, levels, own, totals):
    """`memberships` of rows ``first..last``."""
    sums = np.zeros(levels)
    for j in range(first, last):
        k, end, total = indptr[j], indptr[j + 1], 0.0
        while k < end:
            begin, v = k, view[region[k]]
            sums[:] = 0.0
            while k < end and view[region[k]] == v:
                total += weight[k]
                if group[region[k]] >= 0:
                    sums[group[region[k]] - v * levels] += weight[k]
                k += 1
            for n in range(begin, k):
                g = group[region[n]]
                if g >= 0:
                    most = sums[g - v * levels]
                    own[n] = most > FAINT and weight[n] >= BELONGS * most
        totals[j] = total
