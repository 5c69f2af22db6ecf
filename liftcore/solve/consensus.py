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
"""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from liftcore.jit import kernel
from liftcore.one_thread import one_thread
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.weights import RegionWeights, run_each

BELONGS = 0.7  # of a splat's weight in a level of a view: less, and the splat lies on the border of two regions
FAINT = 0.05  # of rays; a level that weighs less at a splat hardly sees it
OBSERVES = 0.3  # of a region, that a level of a view must see to say anything of it
PRIOR = 2.0  # views' worth of the scene's mean: one view alone may be the one that is wrong
MOST_SPLATS = 1 << 13
MOST_WITNESSES = 64
BLOCK_ENTRIES = 1 << 22
PIECES = 16  # of the rows, for threads
STEPS = 1 << 30  # of a share
ONE_VIEW = 1 << 40  # that says something; MOST_WITNESSES shares are less
UNKNOWN = 1 << 56  # what a tuple says, before anybody asked it


@one_thread()
def mask_consensus(
    W: RegionWeights, levels: np.ndarray, threads: int | None = None, *, means: Tensor | None = None
) -> np.ndarray:
    """c_jm of every entry of W, [nnz] f32 in 0..1; one where nothing in the scene says anything.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        threads: None takes the cores that this process may use. The number changes no bit.
        means: [P, 3] of the splats: neighbours, which belong to the same regions, are read together.
    """
    indptr, region, weight = (tensor.numpy() for tensor in (W.indptr, W.region, W.weight))
    offsets, levels = W.offsets.numpy(), levels.astype(np.int64)
    view = np.repeat(np.arange(offsets.size - 1), np.diff(offsets)).astype(np.int32)
    several = int(levels.max(initial=0)) + 1
    group = np.where(levels < 0, -1, view * several + levels).astype(np.int32)
    rows = np.flatnonzero(np.diff(indptr))
    if means is not None:
        rows = rows[np.argsort(morton_codes(means[torch.from_numpy(rows)]).numpy(), kind="stable")]
    lengths = np.diff(indptr)[rows]
    pieces = [(piece, *ends) for piece, ends in enumerate(_edges(lengths, max(region.size // PIECES, 1)))]
    sizes = np.zeros((len(pieces), levels.size), np.int32)  # of the regions in each piece
    total, own, counts = np.zeros(rows.size), np.zeros(region.size, np.bool_), np.zeros(rows.size + 1, np.int64)
    splat_by_splat = [rows, indptr, region, weight, view, group, several, total, own, counts, sizes]
    run_each(lambda *ends: belong(*ends, *splat_by_splat), pieces, threads)
    starts = np.cumsum(counts)
    tuples, parents, members = number_tuples(rows, indptr, region, own, view, starts)
    consensus, witnesses = np.ones(region.size, np.float32), np.zeros(region.size, np.uint8)
    told, here, whole = 0, indptr[rows], sizes.sum(axis=0, dtype=np.int64)
    for first, last in _edges(whole, BLOCK_ENTRIES):
        begins = np.concatenate([[0], np.cumsum(whole[first:last])])
        at = begins[:-1] + np.cumsum(sizes[:, first:last], axis=0, dtype=np.int64) - sizes[:, first:last]
        splats, there = np.empty(begins[-1], np.int32), here.copy()
        sums, views = np.zeros(begins[-1], np.float32), np.zeros(begins[-1], np.uint8)
        order = [first, last, rows, here, there, indptr, region, own, at, splats]
        run_each(lambda *ends, order=order: by_region(*ends, *order), pieces, threads)
        parts = [(part, *ends) for part, ends in enumerate(_edges(whole[first:last], max(BLOCK_ENTRIES // 64, 1)))]
        shares = np.zeros(len(parts), np.int64)
        block = [first, begins, splats, starts, tuples, parents, members, total]
        block += [view, group, several, sums, views, shares]
        run_each(lambda *ends, block=block: agree(*ends, *block), parts, threads)
        back = [first, here, there, region, at, sums, views, consensus, witnesses]
        run_each(lambda *ends, back=back: by_row(*ends, *back), pieces, threads)
        told, here = told + int(shares.sum()), there
    asked = int(witnesses.sum(dtype=np.int64))
    usual = told / STEPS / asked if asked else 1.0
    run_each(lambda _, a, b: finish(a, b, rows, indptr, consensus, witnesses, usual), pieces, threads)
    return consensus


def _edges(lengths: np.ndarray, entries: int) -> list[tuple[int, int]]:
    """(first, last) of rows with about so many entries together, at least one row each."""
    ends = np.searchsorted(np.cumsum(lengths), np.arange(1, lengths.sum() // entries + 1) * entries)
    edges = np.unique([0, *ends, lengths.size]).tolist()
    return list(pairwise(edges))


@kernel
def belong(piece, first, last, rows, indptr, region, weight, view, group, several, total, own, counts, sizes):
    """For rows ``first..last``: their sums, sizes of regions, which entries belong, and in how many views."""
    sums = np.zeros(several)
    for j in range(first, last):
        k, end = indptr[rows[j]], indptr[rows[j] + 1]
        while k < end:
            begin, v, any_own = k, view[region[k]], False
            sums[:] = 0.0
            while k < end and view[region[k]] == v:
                total[j] += weight[k]
                sizes[piece, region[k]] += 1
                if group[region[k]] >= 0:
                    sums[group[region[k]] - v * several] += weight[k]
                k += 1
            for n in range(begin, k):
                g = group[region[n]]
                if g >= 0:
                    most = sums[g - v * several]
                    if most > FAINT and weight[n] >= BELONGS * most:
                        own[n] = any_own = True
            counts[j + 1] += any_own


@kernel
def number_tuples(rows, indptr, region, own, view, starts):
    """The tuple of each splat and view in which it belongs to a region, and what tuples are made of.

    Returns:
        tuples: [n] i32, of row j from ``starts[j]`` on. parents, members: [T] i32, the tuple without its last region
        (-1: nothing), and that region.
    """
    tuples = np.empty(starts[-1], np.int32)
    parents, members = np.empty(1 << 10, np.int32), np.empty(1 << 10, np.int32)
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
            place = slot(table, parents, members, tuple_, region[k])
            if table[place] < 0:
                if count == parents.size:
                    parents, members = np.concatenate((parents, parents)), np.concatenate((members, members))
                parents[count], members[count], table[place] = tuple_, region[k], count
                count += 1
                if 4 * count > table.size:
                    table = np.full(2 * table.size, -1, np.int32)
                    for other in range(count):
                        table[slot(table, parents, members, parents[other], members[other])] = other
                tuple_ = count - 1
            else:
                tuple_ = table[place]
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
def by_region(piece, begin, end, first, last, rows, here, there, indptr, region, own, at, splats):
    """The splats of the regions ``first..last`` by region, each in the order of rows; below zero: it belongs not.

    Entries of these regions begin ``here`` [rows] i64, and those of later ones ``there``.
    """
    at = at[piece].copy()
    for j in range(begin, end):
        k, stop = here[j], indptr[rows[j] + 1]
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
            every = max((end - begin + MOST_WITNESSES - 1) // MOST_WITNESSES, 1)
            asked = 0
            for k in range(begin, end, every):
                asked += says[tuples[k]]
            if asked >= UNKNOWN:
                asked = 0
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
def finish(first, last, rows, indptr, sums, counts, usual):
    """Sums of q become c, with the scene's mean as PRIOR views."""
    for j in range(first, last):
        for k in range(indptr[rows[j]], indptr[rows[j] + 1]):
            asked = sums[k] if counts[k] > 0 else 0.0
            sums[k] = (asked + PRIOR * usual) / (counts[k] + PRIOR)
