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

Memory is that of the entries that belong, two numbers an entry, and BLOCK_ENTRIES of W by region at a time; no
matrix of regions is ever made, only a row of R for each thread. A row is one thread's, in the order of the
splats, so that the number of threads changes no bit. A region's R comes from MOST_SPLATS of its splats and an entry
asks MOST_WITNESSES views, evenly chosen: a share needs no more.
"""

from itertools import pairwise

import numpy as np

from liftcore.jit import kernel
from liftcore.solve.weights import RegionWeights, run_each

BELONGS = 0.7  # of a splat's weight in a level of a view: less, and the splat lies on the border of two regions
FAINT = 0.05  # of rays; a level that weighs less at a splat hardly sees it
OBSERVES = 0.3  # of a region, that a level of a view must see to say anything of it
PRIOR = 2.0  # views' worth of the scene's mean: one view alone may be the one that is wrong
MOST_SPLATS = 1 << 13
MOST_WITNESSES = 64
BLOCK_ENTRIES = 1 << 22
NO_LEVEL = -1


def mask_consensus(W: RegionWeights, levels: np.ndarray, threads: int | None = None) -> np.ndarray:
    """c_jm of every entry of W, [nnz] f32 in 0..1; one where nothing in the scene says anything.

    Args:
        W: of all views, by rows of codebooks, on the CPU.
        levels: [M] i8, the level of each region in its view; -1 for cells of grids, which take no part.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    indptr, region, weight = (tensor.numpy() for tensor in (W.indptr, W.region, W.weight))
    offsets, levels = W.offsets.numpy(), levels.astype(np.int64)
    regions, rows = levels.size, indptr.size - 1
    view = np.repeat(np.arange(offsets.size - 1), np.diff(offsets)).astype(np.int32)
    several = int(levels.max(initial=0)) + 1
    group = np.where(levels < 0, -1, view * several + levels).astype(np.int32)
    total, own = np.zeros(rows), np.zeros(region.size, np.bool_)
    counts, sizes = np.zeros(rows + 1, np.int64), np.bincount(region, minlength=regions)
    edges = _edges(np.diff(indptr), max(BLOCK_ENTRIES // 16, 1))
    run_each(
        lambda a, b: belong(a, b, indptr, region, weight, view, group, several, total, own, counts), edges, threads
    )
    starts = np.cumsum(counts)
    members = region[own]
    consensus, witnesses = np.ones(region.size, np.float32), np.zeros(region.size, np.uint8)
    cursor = indptr[:-1].copy()
    for first, last in _edges(sizes, BLOCK_ENTRIES):
        begins = np.concatenate([[0], np.cumsum(sizes[first:last])])
        splats, entries = np.empty(begins[-1], np.int32), np.empty(begins[-1], np.int64)
        by_region(first, last, cursor, indptr, region, begins, splats, entries)

        block = [first, begins, splats, entries, own, starts, members, total]
        block += [view, group, several, consensus, witnesses]
        run_each(
            lambda a, b, block=block: agree(a, b, *block),
            _edges(sizes[first:last], max(BLOCK_ENTRIES // 64, 1)),
            threads,
        )
    finish(consensus, witnesses)
    return consensus


def _edges(lengths: np.ndarray, entries: int) -> list[tuple[int, int]]:
    """(first, last) of rows with about so many entries together, at least one row each."""
    ends = np.searchsorted(np.cumsum(lengths), np.arange(1, lengths.sum() // entries + 1) * entries)
    edges = np.unique([0, *ends, lengths.size]).tolist()
    return list(pairwise(edges))


@kernel
def belong(first, last, indptr, region, weight, view, group, several, total, own, counts):
    """For rows ``first..last``: their sums, which entries belong, and how many (at the row + 1)."""
    sums = np.zeros(several)
    for j in range(first, last):
        k, end = indptr[j], indptr[j + 1]
        while k < end:
            begin, v = k, view[region[k]]
            sums[:] = 0.0
            while k < end and view[region[k]] == v:
                total[j] += weight[k]
                if group[region[k]] >= 0:
                    sums[group[region[k]] - v * several] += weight[k]
                k += 1
            for n in range(begin, k):
                g = group[region[n]]
                if g >= 0:
                    most = sums[g - v * several]
                    if most > FAINT and weight[n] >= BELONGS * most:
                        own[n] = True
                        counts[j + 1] += 1


@kernel
def by_region(first, last, cursor, indptr, region, begins, splats, entries):
    """The entries of the regions ``first..last`` by region, each in the order of splats; the cursors [P] move on."""
    at = begins[:-1].copy()
    for j in range(cursor.size):
        k = cursor[j]
        while k < indptr[j + 1] and region[k] < last:
            m = region[k] - first
            splats[at[m]], entries[at[m]] = j, k
            at[m] += 1
            k += 1
        cursor[j] = k


@kernel
def agree(a, b, base, begins, splats, entries, own, starts, members, total, view, group, several, sums, counts):
    """For the regions ``base + a .. base + b``: the sum of q of each of their entries, and of how many views."""
    R, seen = np.zeros(view.size), np.zeros(view[-1] * several + several)
    q, sees = np.zeros(view.size, np.float32), np.zeros(seen.size, np.bool_)
    met = np.empty(view.size, np.int32)
    for m in range(a, b):
        mine, found, size = view[base + m], 0, 0.0
        if group[base + m] < 0:
            continue
        step = (begins[m + 1] - begins[m] + MOST_SPLATS - 1) // MOST_SPLATS
        for place in range(begins[m], begins[m + 1], max(step, 1)):
            if not own[entries[place]]:
                continue
            j = splats[place]
            size += total[j]
            for k in range(starts[j], starts[j + 1]):
                n = members[k]
                if R[n] == 0.0:
                    met[found] = n
                    found += 1
                R[n] += total[j]
        for i in range(found):
            seen[group[met[i]]] += R[met[i]]
        for i in range(found):
            n = met[i]
            sees[group[n]] = view[n] != mine and seen[group[n]] >= OBSERVES * size
            q[n] = R[n] / seen[group[n]]
        for place in range(begins[m], begins[m + 1]):
            j, asked, number = splats[place], np.float32(0.0), 0
            k, end = starts[j], starts[j + 1]
            every, turn = (end - k) // (several * MOST_WITNESSES) + 1, 0
            while k < end:
                v, best = view[members[k]], np.float32(-1.0)
                while k < end and view[members[k]] == v:
                    if sees[group[members[k]]]:
                        best = max(best, q[members[k]])
                    k += 1
                if best >= 0.0 and turn % every == 0:
                    asked += best
                    number += 1
                turn += 1
            sums[entries[place]], counts[entries[place]] = asked, number
        for i in range(found):
            n = met[i]
            seen[group[n]], sees[group[n]], R[n], q[n] = 0.0, False, 0.0, 0.0


@kernel
def finish(sums, counts):
    """Sums of q become c: with the scene's mean as PRIOR views; one where there is no mean."""
    everything, views = 0.0, 0
    for k in range(sums.size):
        if counts[k] > 0:
            everything += sums[k]
            views += counts[k]
    usual = everything / views if views > 0 else 1.0
    for k in range(sums.size):
        asked = sums[k] if counts[k] > 0 else 0.0
        sums[k] = (asked + PRIOR * usual) / (counts[k] + PRIOR)
