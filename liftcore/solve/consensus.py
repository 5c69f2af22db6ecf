"""Mask consensus: does what other views see as one thing go with a splat as this region does? No feature is read.

A mask that merges two things holds splats that other views keep apart. W knows that. With ``j in m`` where region m
has at least BELONGS of splat j's weight in its group g (a level of a view), and ``t_j`` the sum of row j of W::

    R_mn = sum of t_j over the splats j in both m and n          vis_mg = sum of R_mn over the regions n of g
    q_jmv = the largest R_mn / vis_mg(n) of the regions n of view v with j in n
    c_jm  = (sum of q_jmv over the other views + PRIOR c) / (their number + PRIOR)

g counts for m where ``vis_mg >= OBSERVES R_mm``: where it sees enough of m to say anything. q is the share of m that
another view puts into one region with j. Of a right mask that is about one; of two merged things a splat gets the
share of its own one. c is the mean of all q of the scene, so that where no other view says anything the factor is the
usual one. Each part has its reason:

- **For each entry, not for each region.** A large right mask that others cut to pieces keeps what most of it says,
  and a small thing in the mask of a large one loses all of it where the large one loses nothing.
- **The best level of a view** speaks for it: an object is no mistake beside its parts.
- **Shares of m, not overlaps of m with n**: a part is no mistake inside its object.
- **Splats count by their weight**, as faint and hidden ones belong to what they are seen through.
- **A soft share, no yes or no**: 79 % in one region and 81 % are the same evidence.

Grids have no masks: each cell is a region that neighbouring cells of all other views cut, whatever it shows, so the
share says how cells lie and nothing of what they show. Views of grids take no part, neither as m nor as witness.

Each view says what it says of a splat by the **tuple** of regions, one a level, that the splat belongs to. Splats are
many and tuples few, so R is counted by tuple, and of a tuple its best level is taken once. Shares are summed as whole
numbers of STEPS: the order of the views then changes no bit.

Memory is that of the entries, a number and a byte each, of a tuple a splat and view, and of BLOCK_ENTRIES of W by
region at a time; no matrix of regions is ever made, only a row of R for each thread. A region's R comes from
MOST_SPLATS of its splats and an entry asks MOST_WITNESSES views, evenly chosen: a share needs no more.

**How it splits.** A tuple is a function of the splat's weights in one view, so views number their own
(`splat_tuples`). The sums of q of the entries of a view (`region_shares`) need of other views the tuples of its
splats and their t_j, and nothing else: a few bytes a splat and view. What is summed over the scene are whole numbers,
and the scene's mean comes last (`with_mean`), where a block of splats uses its entries. Splats are read along one
curve through the scene, whoever reads them (`along_curve`), for the sampled ones depend on it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.membership import Memberships, RegionGroups, memberships
from liftcore.values.region_weights import RegionWeights, run_each

OBSERVES = 0.3  # of a region, that a level of a view must see to say anything of it
PRIOR = 2.0  # views' worth of the scene's mean: one view alone may be the one that is wrong
MOST_SPLATS = 1 << 12  # of equal weight give a share to a standard error of .5 / 64 = .008 at most
MOST_WITNESSES = 24  # give a mean q to .1 at most, and PRIOR draws it by 2 in 26; more cost time (docs/results.md)
BLOCK_ENTRIES = 1 << 23  # a pass over all rows each
PIECES = 16  # of the rows, for threads
STEPS = 1 << 30  # of a share
ONE_VIEW = 1 << 40  # that says something; MOST_WITNESSES shares are less
UNKNOWN = 1 << 56  # what a tuple says, before anybody asked it


@dataclass(frozen=True)
class SplatTuples:
    """The tuple of each splat in every view in which it belongs to a region, and what tuples are made of."""

    starts: np.ndarray  # [n + 1] i64, where the tuples of each splat begin
    tuples: np.ndarray  # i32, ascending by view in a splat
    parents: np.ndarray  # [T] i32, the tuple without its last region; -1: nothing
    members: np.ndarray  # [T] i32, its last region


@dataclass(frozen=True)
class RegionShares:
    """What other views say of the entries of some regions."""

    sums: np.ndarray  # [nnz] f32, of q over the views that say anything
    views: np.ndarray  # [nnz] u8, how many these are
    told: int  # the sum of all q, in STEPS

    @property
    def asked(self) -> int:
        """The number of all q."""
        return int(self.views.sum(dtype=np.int64))


@one_thread()
def mask_consensus(
    W: RegionWeights,
    levels: np.ndarray,
    threads: int | None = None,
    *,
    means: Tensor | None = None,
    members: Memberships | None = None,
) -> np.ndarray:
    """c_jm of every entry of W, [nnz] f32 in 0..1; one where nothing in the scene says anything.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        threads: None takes the cores that this process may use. The number changes no bit.
        means: [P, 3] of the splats: neighbours, which belong to the same regions, are read together.
        members: of W, where they are known.
    """
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    members = members or memberships(W, groups, threads)
    rows = np.flatnonzero(np.diff(W.indptr.numpy()))
    if means is not None:
        rows = rows[along_curve(means[torch.from_numpy(rows)])]
    tuples = splat_tuples(W, members.own, groups, rows, threads)
    shares = region_shares(W, members.own, groups, rows, members.totals[rows], tuples, threads=threads)
    return with_mean(shares.sums, shares.views, mean_share(shares.told, shares.asked), threads)


def along_curve(points: Tensor, bounds: Tensor | None = None) -> np.ndarray:
    """[n] i64: the order of points along a curve that fills space; those of one place keep theirs.

    Args:
        points: [n, 3], any frame. bounds: [2, 3] f64, the least and the greatest of the scene; None: of the points.
    """
    return np.argsort(morton_codes(points, bounds).numpy(), kind="stable")


def mean_share(told: int, asked: int) -> float:
    """c, the mean of all q, from their sum in STEPS and their number; one where there is none."""
    return told / STEPS / asked if asked else 1.0


def with_mean(sums: np.ndarray, views: np.ndarray, usual: float, threads: int | None = None) -> np.ndarray:
    """Sums of q become c_jm, in place: [nnz] f32, as `RegionShares` has both."""
    step = BLOCK_ENTRIES >> 3
    blocks = [(first, min(first + step, sums.size)) for first in range(0, sums.size, step)]
    run_each(lambda first, last: finish(first, last, sums, views, usual), blocks, threads)
    return sums


def splat_tuples(
    W: RegionWeights, own: np.ndarray, groups: RegionGroups, rows: np.ndarray, threads: int | None = None
) -> SplatTuples:
    """The tuples of some rows of W [n] i64, in their order.

    Args:
        W, own: as `memberships` has them, of any views.
    """
    indptr, region = W.indptr.numpy(), W.region.numpy()
    counts = np.zeros(rows.size + 1, np.int64)
    pieces = _edges(np.diff(indptr)[rows], max(region.size // PIECES, 1))
    arrays = rows, indptr, region, own, groups.view, counts
    run_each(lambda *ends: count_views(*[*ends, *arrays]), pieces, threads)
    starts = np.cumsum(counts)
    return SplatTuples(starts, *number_tuples(rows, indptr, region, own, groups.view, starts))


def region_shares(
    W: RegionWeights,
    own: np.ndarray,
    groups: RegionGroups,
    rows: np.ndarray,
    totals: np.ndarray,
    tuples: SplatTuples,
    *,
    base: int = 0,
    threads: int | None = None,
) -> RegionShares:
    """The sums of q of all entries of W, which has all splats of its regions.

    Args:
        W, own: as `memberships` has them, of the regions ``base..base + offsets[-1]`` alone.
        rows: [n] i64, those of W that have entries, in the order in which splats are read.
        totals: [n] f64, t_j of these. tuples: of these, in all views.
    """
    indptr, region = W.indptr.numpy(), W.region.numpy()
    pieces = [
        (piece, *ends) for piece, ends in enumerate(_edges(np.diff(indptr)[rows], max(region.size // PIECES, 1)))
    ]
    sizes = np.zeros((len(pieces), int(W.offsets[-1])), np.int32)  # of the regions in each piece
    arrays = rows, indptr, region, base, sizes
    run_each(lambda *ends: count_splats(*[*ends, *arrays]), pieces, threads)
    consensus, witnesses = np.ones(region.size, np.float32), np.zeros(region.size, np.uint8)
    told, here, stops, whole = 0, indptr[rows], indptr[rows + 1], sizes.sum(axis=0, dtype=np.int64)
    for first, last in _edges(whole, BLOCK_ENTRIES):
        begins = np.concatenate([[0], np.cumsum(whole[first:last])])
        at = begins[:-1] + np.cumsum(sizes[:, first:last], axis=0, dtype=np.int64) - sizes[:, first:last]
        splats, there = np.empty(begins[-1], np.int32), here.copy()
        sums, views = np.zeros(begins[-1], np.float32), np.zeros(begins[-1], np.uint8)
        order = [base + first, base + last, here, there, stops, region, own, at, splats]
        run_each(lambda *ends, order=order: by_region(*ends, *order), pieces, threads)
        parts = [(part, *ends) for part, ends in enumerate(_edges(whole[first:last], max(BLOCK_ENTRIES // 128, 1)))]
        shares = np.zeros(len(parts), np.int64)
        block = [base + first, begins, splats, tuples.starts, tuples.tuples, tuples.parents, tuples.members, totals]
        block += [groups.view, groups.group, groups.levels, sums, views, shares]
        run_each(lambda *ends, block=block: agree(*ends, *block), parts, threads)
        back = [base + first, here, there, region, at, sums, views, consensus, witnesses]
        run_each(lambda *ends, back=back: by_row(*ends, *back), pieces, threads)
        told, here = told + int(shares.sum()), there
    return RegionShares(consensus, witnesses, told)


def _edges(lengths: np.ndarray, entries: int) -> list[tuple[int, int]]:
    """(first, last) of rows with about so many entries together, at least one row each."""
    ends = np.searchsorted(np.cumsum(lengths), np.arange(1, lengths.sum() // entries + 1) * entries)
    edges = np.unique([0, *ends, lengths.size]).tolist()
    return list(pairwise(edges))


@kernel
def count_views(first, last, rows, indptr, region, own, view, counts):
    """Of rows ``first..last``, the number of views in which they belong to a region, at the row + 1."""
    for j in range(first, last):
        before = -1
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            if own[k] and view[region[k]] != before:
                before = view[region[k]]
                counts[j + 1] += 1


@kernel
def count_splats(piece, first, last, rows, indptr, region, base, sizes):
    """The entries of each region in rows ``first..last``."""
    for j in range(first, last):
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            sizes[piece, region[k] - base] += 1


@kernel
def number_tuples(rows, indptr, region, own, view, starts):
    """`SplatTuples` of some rows, whose own begin at ``starts``: tuples, parents and members.

    A splat mostly has the tuples of the one before it, so what last followed a tuple is tried before the hash table.
    """
    tuples = np.empty(starts[-1], np.int32)
    parents, members = np.empty(1 << 10, np.int32), np.empty(1 << 10, np.int32)
    followers, begun = np.full(1 << 10, -1, np.int32), np.full(view[-1] + 1 if view.size else 0, -1, np.int32)
    table, count = np.full(1 << 12, -1, np.int32), 0
    for j in range(rows.size):
        at, last, tuple_ = starts[j], -1, -1
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            if not own[k]:
                continue
            if last >= 0 and view[region[k]] != last:
                tuples[at] = tuple_
                at, tuple_ = at + 1, -1
            last = view[region[k]]
            near = followers[tuple_] if tuple_ >= 0 else begun[last]
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
                begun[last] = near
            tuple_ = near
        if last >= 0:
            tuples[at] = tuple_
    return tuples, parents[:count].copy(), members[:count].copy()


@kernel
def slot(table, parents, members, parent, member):
    """Where the tuple ``parent`` with ``member`` lies in the hash table of tuples, or is to lie."""
    place = ((np.int64(parent) + 1) * 0x85EBCA77 ^ np.int64(member) * 0x9E3779B1) >> 7 & table.size - 1
    while table[place] >= 0 and (parents[table[place]] != parent or members[table[place]] != member):
        place = place + 1 & table.size - 1
    return place


@kernel
def by_region(piece, begin, end, first, last, here, there, stops, region, own, at, splats):
    """The splats of the regions ``first..last`` by region, each in the order of rows; below zero: it belongs not.

    Entries of these regions begin ``here`` [rows] i64, those of later ones ``there``; rows end at ``stops``.
    """
    at = at[piece].copy()
    for j in range(begin, end):
        k, stop = here[j], stops[j]
        while k < stop and region[k] < last:
            m = region[k] - first
            splats[at[m]] = j if own[k] else ~j
            at[m] += 1
            k += 1
        there[j] = k


@kernel
def by_row(piece, begin, end, first, here, there, region, at, sums, views, consensus, witnesses):
    """What was found by region goes to the entries of W."""
    at = at[piece].copy()
    for j in range(begin, end):
        for k in range(here[j], there[j]):
            m = region[k] - first
            consensus[k], witnesses[k] = sums[at[m]], views[at[m]]
            at[m] += 1


@kernel
def agree(
    number, a, b, base, begins, splats, starts, tuples, parents, members, total, view, group, several,
    sums, counts, told,
):  # fmt: skip
    """For the regions ``base + a .. base + b``: the sum of q of each of their entries, and of how many views."""
    shared, seen = np.zeros(members.size), np.zeros((view[-1] + 1) * several)
    R, says = np.zeros(view.size), np.full(members.size, UNKNOWN)
    met = np.empty(members.size, np.int32)
    for m in range(a, b):
        mine, found, size = view[base + m], 0, 0.0
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
                    met[found] = t
                    found += 1
                shared[t] += total[j]
        known = found
        for i in range(found):
            t = met[i]
            while t >= 0:
                n = members[t]
                R[n] += shared[met[i]]
                seen[group[n]] += shared[met[i]]
                t = parents[t]
        for i in range(found):
            says[met[i]] = best_share(met[i], mine, OBSERVES * size, R, seen, parents, members, view, group)
        for place in range(begins[m], begins[m + 1]):
            j = splats[place] if splats[place] >= 0 else ~splats[place]
            begin, end = starts[j], starts[j + 1]
            every, asked = np.int64(1), np.int64(0)
            if end - begin <= MOST_WITNESSES:  # of most splats: a loop of steps of one is the fast one
                for k in range(begin, end):
                    asked += says[tuples[k]]
            else:
                every = (end - begin + MOST_WITNESSES - 1) // MOST_WITNESSES
                for k in range(begin, end, every):
                    asked += says[tuples[k]]
            if asked >= UNKNOWN:
                asked = np.int64(0)
                for k in range(begin, end, every):
                    t = tuples[k]
                    if says[t] == UNKNOWN:
                        says[t] = best_share(t, mine, OBSERVES * size, R, seen, parents, members, view, group)
                        met[known] = t
                        known += 1
                    asked += says[t]
            sums[place], counts[place] = (asked & ONE_VIEW - 1) / STEPS, asked // ONE_VIEW
            told[number] += asked & ONE_VIEW - 1
        for i in range(known):
            t = met[i]
            shared[t], says[t] = 0.0, UNKNOWN
            while t >= 0:
                R[members[t]] = seen[group[members[t]]] = 0.0
                t = parents[t]


@kernel
def best_share(t, mine, enough, R, seen, parents, members, view, group):
    """What tuple t says of a region of view ``mine`` and its row R: its best q in STEPS, and ONE_VIEW; or nothing."""
    best = -1.0
    if view[members[t]] != mine:
        while t >= 0:
            n = members[t]
            if seen[group[n]] >= enough and seen[group[n]] > 0.0:
                best = max(best, R[n] / seen[group[n]])
            t = parents[t]
    return ONE_VIEW + np.int64(best * STEPS + 0.5) if best >= 0.0 else 0


@kernel
def finish(first, last, sums, views, usual):
    """Sums of q become c, with the scene's mean as PRIOR views."""
    for k in range(first, last):
        asked = sums[k] if views[k] > 0 else 0.0
        sums[k] = (asked + PRIOR * usual) / (views[k] + PRIOR)
