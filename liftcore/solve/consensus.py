"""Mask consensus: agreement of other views that a splat belongs to the object of a region. Features are not used.

A mask that merges two objects has splats that other views separate, which W shows. With ``j in m`` if splat j
belongs to region m (below) of the group g, a level of a view, and ``t_j`` the sum of row j of W::

    R_mn = sum of t_j over the splats j in both m and n          vis_mg = sum of R_mn over the regions n of g
    q_jmv = the largest R_mn / vis_mg(n) of the regions n of view v with j in n
    c_jm  = (sum of q_jmv over the other views + PRIOR c) / (their number + PRIOR)

g counts for m if ``vis_mg >= OBSERVES R_mm``: it sees enough of m. q is the share of m that another view puts into
one region with j. For a correct mask it is about one; for two merged objects a splat gets that of its own object.
c is the mean of all q of the scene, so that an entry without other views has the average factor. The reason for each
part:

- **Per entry, not per region.** A large correct mask that other views split keeps its weight at most splats, and a
  small object in the mask of a large one loses its weight where the large one loses nothing.
- **The best level of a view** counts: an object is no mistake if another level has its parts.
- **Shares of m, not overlaps of m with n**: a part is no mistake inside its object.
- **Splats count by their weight**, as faint and hidden ones belong to the object in front of or behind them.
- **A soft share, not a threshold**: 79 % and 81 % in one region are the same evidence.

Grids have no masks: each cell is a region that cells of all other views split, for any content, so its share is
meaningless. Views of grids are ignored, both as m and as other views.

A view's regions of a splat, one per level, form a **tuple**. There are many splats and few tuples, so R is counted
per tuple, and the best level of a tuple is computed once. Shares are summed as integers in units of 1 / STEPS, so the
result is bitwise identical for any order of views.

Memory is that of the entries, a number and a byte each, of a tuple per splat and view, and of BLOCK_ENTRIES of W by
region at a time; there is no matrix of regions, only a row of R per thread. A region's R is estimated from
MOST_SPLATS of its splats, and an entry's sum from MOST_WITNESSES views, evenly chosen.

**Memberships.** Splat j belongs to region m if m has at least BELONGS of the splat's weight in its group, and the
group has more weight than FAINT there. A splat with an entry of a region need not belong to it: on the border of two
regions it belongs to neither. A membership is a function of the splat's weights in one view.

**Blocks of views.** A tuple is a function of the splat's weights in one view, so views number their own tuples
(`splat_tuples`). The sums of q of a view's entries (`region_shares`) need only the tuples of its splats in other
views and their t_j: a few bytes per splat and view. Sums over the scene are integers, and the scene's mean is applied
last (`with_mean`), when a block of splats uses its entries. Splats are always read along one space-filling curve
(`along_curve`), as the sampled splats depend on their order.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.solve.closed_form import morton_codes
from liftcore.values.region_weights import RegionWeights, run_each

BELONGS = 0.7  # of a splat's weight in a level of a view; with less, the splat lies on the border of two regions
FAINT = 0.05  # sum of weights below which a level hardly sees a splat
OBSERVES = 0.3  # share of a region that a level of a view must see to observe it
PRIOR = 2.0  # weight of the scene's mean, in views: a single other view may be the wrong one
MOST_SPLATS = 1 << 12  # of equal weight estimate a share with a standard error of .5 / 64 = .008 at most
MOST_WITNESSES = 24  # views; the mean q has an error of .1 at most, and PRIOR shifts it by 2 in 26 (docs/results.md)
BLOCK_ENTRIES = 1 << 23  # per pass over all rows
PIECES = 16  # of the rows, for threads
STEPS = 1 << 30  # units of a share
ONE_VIEW = 1 << 40  # counts an observing view; the sum of MOST_WITNESSES shares is less
UNKNOWN = 1 << 56  # answer of a tuple that is not computed yet


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
    """
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    own_region = np.zeros(region.size, np.bool_)
    arrays = indptr, region, weight, groups.view, groups.group, groups.levels, own_region
    run_each(lambda first, last: mark_memberships(first, last, *arrays), W.blocks(1 << 16, 1 << 18), threads)
    return own_region


@dataclass(frozen=True)
class SplatTuples:
    """The tuple of each splat in every view in which it belongs to a region, and the regions of tuples."""

    starts: np.ndarray  # [n + 1] i64, offsets of each splat's tuples
    tuples: np.ndarray  # i32, ascending by view in a splat
    parents: np.ndarray  # [T] i32, the tuple without its last region; -1 if empty
    members: np.ndarray  # [T] i32, the last region of a tuple


def along_curve(points: Tensor, bounds: Tensor | None = None) -> np.ndarray:
    """Return the order [n] i64 of points along a space-filling curve; equal points keep their order.

    Args:
        points: [n, 3], any frame. bounds: [2, 3] f64, minimum and maximum of the scene; None: of the points.
    """
    return np.argsort(morton_codes(points, bounds).numpy(), kind="stable")


def mean_share(share_sum: int, share_count: int) -> float:
    """Return c, the mean of all q, from their sum in STEPS and their number; one if there is none."""
    return share_sum / STEPS / share_count if share_count else 1.0


def with_mean(sums: np.ndarray, views: np.ndarray, mean: float, threads: int | None = None) -> np.ndarray:
    """Replace sums of q [nnz] f32 (`region_shares`) by c_jm, in place."""
    step = BLOCK_ENTRIES >> 3
    blocks = [(first, min(first + step, sums.size)) for first in range(0, sums.size, step)]
    run_each(lambda first, last: blend_with_mean(first, last, sums, views, mean), blocks, threads)
    return sums


def splat_tuples(W: RegionWeights, own_region: np.ndarray, groups: RegionGroups, rows: np.ndarray) -> SplatTuples:
    """Return the tuples of some rows of W [n] i64, in their order.

    Args:
        W, own_region: as `memberships` has them, of any views.
    """
    return SplatTuples(*number_tuples(rows, W.indptr.numpy(), W.region.numpy(), own_region, groups.view))


def region_shares(
    W: RegionWeights,
    own_region: np.ndarray,
    groups: RegionGroups,
    rows: np.ndarray,
    totals: np.ndarray,
    tuples: SplatTuples,
    *,
    base: int = 0,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the sums of q over the other views, of all entries of W, which has all splats of its regions.

    Args:
        W, own_region: of the regions ``base..base + offsets[-1]`` (`memberships`).
        rows: [n] i64, rows of W with entries, in the order in which splats are read.
        totals: [n] f64, t_j of these rows. tuples: of these rows, in all views.

    Returns:
        [nnz] f32, and the number of observing views [nnz] u8; the sum of all q, in STEPS.
    """
    indptr, region = W.indptr.numpy(), W.region.numpy()
    pieces = [
        (piece, *ends) for piece, ends in enumerate(_edges(np.diff(indptr)[rows], max(region.size // PIECES, 1)))
    ]
    sizes = np.zeros((len(pieces), int(W.offsets[-1])), np.int32)  # of the regions in each piece
    arrays = rows, indptr, region, base, sizes
    run_each(lambda *ends: count_splats(*[*ends, *arrays]), pieces, threads)
    consensus, witnesses = np.ones(region.size, np.float32), np.zeros(region.size, np.uint8)
    share_sum, cursors, stops, region_sizes = 0, indptr[rows], indptr[rows + 1], sizes.sum(axis=0, dtype=np.int64)
    for first, last in _edges(region_sizes, BLOCK_ENTRIES):
        begins = np.concatenate([[0], np.cumsum(region_sizes[first:last])])
        at = begins[:-1] + np.cumsum(sizes[:, first:last], axis=0, dtype=np.int64) - sizes[:, first:last]
        splats, next_cursors = np.empty(begins[-1], np.int32), cursors.copy()
        sums, views = np.zeros(begins[-1], np.float32), np.zeros(begins[-1], np.uint8)
        order = [base + first, base + last, cursors, next_cursors, stops, region, own_region, at, splats]
        run_each(lambda *ends, order=order: group_by_region(*ends, *order), pieces, threads)
        parts = [
            (part, *ends) for part, ends in enumerate(_edges(region_sizes[first:last], max(BLOCK_ENTRIES // 128, 1)))
        ]
        shares = np.zeros(len(parts), np.int64)
        block = [base + first, begins, splats, tuples.starts, tuples.tuples, tuples.parents, tuples.members, totals]
        block += [groups.view, groups.group, groups.levels, sums, views, shares]
        run_each(lambda *ends, block=block: sum_region_shares(*ends, *block), parts, threads)
        back = [base + first, cursors, next_cursors, region, at, sums, views, consensus, witnesses]
        run_each(lambda *ends, back=back: return_to_rows(*ends, *back), pieces, threads)
        share_sum, cursors = share_sum + int(shares.sum()), next_cursors
    return consensus, witnesses, share_sum


def _edges(lengths: np.ndarray, entries: int) -> list[tuple[int, int]]:
    """Return ranges (first, last) of rows with about ``entries`` entries together, at least one row each."""
    ends = np.searchsorted(np.cumsum(lengths), np.arange(1, lengths.sum() // entries + 1) * entries)
    edges = np.unique([0, *ends, lengths.size]).tolist()
    return list(pairwise(edges))


@kernel
def count_splats(piece, first, last, rows, indptr, region, base, sizes):
    """Count the entries of each region in rows ``first..last``."""
    for j in range(first, last):
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            sizes[piece, region[k] - base] += 1


@kernel
def number_tuples(rows, indptr, region, own_region, view):
    """Number the tuples of some rows: return the arrays of `SplatTuples`.

    A splat mostly has the tuples of the splat before, so the last successor of a tuple is tried before the hash
    table.
    """
    starts, tuples = np.zeros(rows.size + 1, np.int64), np.empty(region.size, np.int32)  # of which few are written
    parents, members = np.empty(1 << 10, np.int32), np.empty(1 << 10, np.int32)
    followers, first_tuples = np.full(1 << 10, -1, np.int32), np.full(view[-1] + 1 if view.size else 0, -1, np.int32)
    table, count = np.full(1 << 12, -1, np.int32), 0
    for j in range(rows.size):
        at, last, tuple_ = starts[j], -1, -1
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            if not own_region[k]:
                continue
            if last >= 0 and view[region[k]] != last:
                tuples[at] = tuple_
                at, tuple_ = at + 1, -1
            last = view[region[k]]
            near = followers[tuple_] if tuple_ >= 0 else first_tuples[last]
            if near >= 0 and members[near] == region[k]:
                tuple_ = near
                continue
            place = slot(table, parents, members, tuple_, region[k])
            near = table[place]
            if near < 0:
                if count == parents.size:
                    parents, members = np.concatenate((parents, parents)), np.concatenate((members, members))
                    followers = np.concatenate((followers, np.full(count, -1, np.int32)))
                near = count
                parents[near], members[near], table[place] = tuple_, region[k], near
                count += 1
                if 4 * count > table.size:
                    table = np.full(2 * table.size, -1, np.int32)
                    for other in range(count):
                        table[slot(table, parents, members, parents[other], members[other])] = other
            if tuple_ >= 0:
                followers[tuple_] = near
            else:
                first_tuples[last] = near
            tuple_ = near
        if last >= 0:
            tuples[at] = tuple_
            at += 1
        starts[j + 1] = at
    return starts, tuples[: starts[-1]].copy(), parents[:count].copy(), members[:count].copy()


@kernel
def slot(table, parents, members, parent, member):
    """Return the slot of the tuple ``parent`` with ``member`` in the hash table, or the slot to insert it."""
    place = ((np.int64(parent) + 1) * 0x85EBCA77 ^ np.int64(member) * 0x9E3779B1) >> 7 & table.size - 1
    while table[place] >= 0 and (parents[table[place]] != parent or members[table[place]] != member):
        place = place + 1 & table.size - 1
    return place


@kernel
def group_by_region(piece, begin, end, first, last, cursors, next_cursors, stops, region, own_region, at, splats):
    """List the splats of the regions ``first..last`` by region, in the order of rows.

    A negative ``~j``: splat j has an entry of the region but does not belong to it.

    Entries of these regions begin at ``cursors`` [rows] i64, of later ones at ``next_cursors``; rows end at
    ``stops``.
    """
    at = at[piece].copy()
    for j in range(begin, end):
        k, stop = cursors[j], stops[j]
        while k < stop and region[k] < last:
            m = region[k] - first
            splats[at[m]] = j if own_region[k] else ~j
            at[m] += 1
            k += 1
        next_cursors[j] = k


@kernel
def return_to_rows(piece, begin, end, first, cursors, next_cursors, region, at, sums, views, consensus, witnesses):
    """Copy results by region to the entries of W."""
    at = at[piece].copy()
    for j in range(begin, end):
        for k in range(cursors[j], next_cursors[j]):
            m = region[k] - first
            consensus[k], witnesses[k] = sums[at[m]], views[at[m]]
            at[m] += 1


@kernel
def sum_region_shares(
    number, a, b, base, begins, splats, starts, tuples, parents, members, total, view, group, several,
    sums, counts, share_sums,
):  # fmt: skip
    """Sum q of each entry of the regions ``base + a .. base + b``, and count the observing views."""
    shared, group_weights = np.zeros(members.size), np.zeros((view[-1] + 1) * several)
    R, answers = np.zeros(view.size), np.full(members.size, UNKNOWN)
    hit_tuples = np.empty(members.size, np.int32)
    for m in range(a, b):
        own_view, count, size = view[base + m], 0, 0.0
        if group[base + m] < 0:
            continue
        step = (begins[m + 1] - begins[m] + MOST_SPLATS - 1) // MOST_SPLATS
        for place in range(begins[m], begins[m + 1], max(step, 1)):
            j = splats[place]
            if j < 0:
                continue
            size += total[j]
            for k in range(starts[j], starts[j + 1]):
                t = tuples[k]
                if shared[t] == 0.0:
                    hit_tuples[count] = t
                    count += 1
                shared[t] += total[j]
        hit_count = count
        for i in range(count):
            t = hit_tuples[i]
            while t >= 0:
                n = members[t]
                R[n] += shared[hit_tuples[i]]
                group_weights[group[n]] += shared[hit_tuples[i]]
                t = parents[t]
        for i in range(count):
            answers[hit_tuples[i]] = best_share(
                hit_tuples[i], own_view, OBSERVES * size, R, group_weights, parents, members, view, group
            )
        for place in range(begins[m], begins[m + 1]):
            j = splats[place] if splats[place] >= 0 else ~splats[place]
            begin, end = starts[j], starts[j + 1]
            stride, packed_sum = np.int64(1), np.int64(0)
            if end - begin <= MOST_WITNESSES:  # most splats; a loop with stride one is faster
                for k in range(begin, end):
                    packed_sum += answers[tuples[k]]
            else:
                stride = (end - begin + MOST_WITNESSES - 1) // MOST_WITNESSES
                for k in range(begin, end, stride):
                    packed_sum += answers[tuples[k]]
            if packed_sum >= UNKNOWN:
                packed_sum = np.int64(0)
                for k in range(begin, end, stride):
                    t = tuples[k]
                    if answers[t] == UNKNOWN:
                        answers[t] = best_share(
                            t, own_view, OBSERVES * size, R, group_weights, parents, members, view, group
                        )
                        hit_tuples[hit_count] = t
                        hit_count += 1
                    packed_sum += answers[t]
            sums[place], counts[place] = (packed_sum & ONE_VIEW - 1) / STEPS, packed_sum // ONE_VIEW
            share_sums[number] += packed_sum & ONE_VIEW - 1
        for i in range(hit_count):
            t = hit_tuples[i]
            shared[t], answers[t] = 0.0, UNKNOWN
            while t >= 0:
                R[members[t]] = group_weights[group[members[t]]] = 0.0
                t = parents[t]


@kernel
def best_share(t, own_view, least_weight, R, group_weights, parents, members, view, group):
    """Return ONE_VIEW plus the best q in STEPS of tuple t for a region of ``own_view`` with row R; 0 if none."""
    best = -1.0
    if view[members[t]] != own_view:
        while t >= 0:
            n = members[t]
            if group_weights[group[n]] >= least_weight and group_weights[group[n]] > 0.0:
                best = max(best, R[n] / group_weights[group[n]])
            t = parents[t]
    return ONE_VIEW + np.int64(best * STEPS + 0.5) if best >= 0.0 else 0


@kernel
def blend_with_mean(first, last, sums, views, mean):
    """Replace sums of q by c, with the scene's mean as PRIOR views."""
    for k in range(first, last):
        total = sums[k] if views[k] > 0 else 0.0
        sums[k] = (total + PRIOR * mean) / (views[k] + PRIOR)


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
