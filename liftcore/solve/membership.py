"""Memberships: the regions of each view to which a splat belongs, for mask consensus and objects.

Splat j belongs to region m if m has at least BELONGS of the splat's weight in its group, a level of a view, and the
group has more weight than FAINT there. A splat with an entry of a region need not belong to it: on the border of two
regions it belongs to neither.

A membership is a function of the splat's weights in one view, so blocks of splats and blocks of views give the same.
"""

from dataclasses import dataclass

import numpy as np

from liftcore.runtime.jit import kernel
from liftcore.values.region_weights import RegionWeights, run_each

BELONGS = 0.7  # of a splat's weight in a level of a view; with less, the splat lies on the border of two regions
FAINT = 0.05  # sum of weights below which a level hardly sees a splat


@dataclass(frozen=True)
class RegionGroups:
    """The view and the group of each region of all views. Cells of grids have no group and are ignored."""

    views: int  # V
    view: np.ndarray  # [M] i32
    group: np.ndarray  # [M] i32, view * levels + level; -1 for cells of grids
    levels: int  # the maximum over views, at least one

    @classmethod
    def of(cls, offsets: np.ndarray, levels: np.ndarray) -> "RegionGroups":
        """Build from the first region of each view [V + 1] i64 and the level of each region [M] i8, -1 for cells."""
        view = np.repeat(np.arange(offsets.size - 1), np.diff(offsets)).astype(np.int32)
        several = int(levels.max(initial=0)) + 1
        return cls(
            offsets.size - 1, view, np.where(levels < 0, -1, view * several + levels).astype(np.int32), several
        )


def memberships(W: RegionWeights, groups: RegionGroups, threads: int | None = None) -> np.ndarray:
    """Return [nnz] bool: the entries of W whose splat belongs to their region.

    Args:
        W: of views by rows of codebooks, on the CPU; its regions are numbered as those of the groups.
        threads: None uses the cores that this process may use. The result is bitwise identical for any value.
    """
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    own_region = np.zeros(region.size, np.bool_)
    arrays = indptr, region, weight, groups.view, groups.group, groups.levels, own_region
    run_each(lambda first, last: mark_memberships(first, last, *arrays), W.blocks(1 << 16, 1 << 18), threads)
    return own_region


@kernel
def mark_memberships(first, last, indptr, region, weight, view, group, levels, own_region):
    """Compute `memberships` of rows ``first..last``."""
    sums = np.zeros(levels)
    for j in range(first, last):
        k, end = indptr[j], indptr[j + 1]
        while k < end:
            begin, v = k, view[region[k]]
            sums[:] = 0.0
            while k < end and view[region[k]] == v:
                if group[region[k]] >= 0:
                    sums[group[region[k]] - v * levels] += weight[k]
                k += 1
            for n in range(begin, k):
                g = group[region[n]]
                if g >= 0:
                    group_weight = sums[g - v * levels]
                    own_region[n] = group_weight > FAINT and weight[n] >= BELONGS * group_weight
