"""The steps of a lift from W to X; a step works on a piece of views, or on a block of splats (`lifting.pieces`).

A step is a function ``(pieces, piece, threads)`` that loads the arrays of earlier steps and saves its own. Sums over
the scene are saved by pieces of splats (`liftcore.solve.sums`); `lifting.algebra` adds them up and saves the totals
as tables. So the result is bitwise identical for any division of the scene.

    step      piece of   saves
    gather    splats     W of all views, a row a splat, its sums and total weight (in memory `lifting.in_memory`)
    relate    views      the regions that their splats belong to, as tuples (`liftcore.solve.consensus`)
    join      splats     the tuples of all views
    contain   views      the regions that contain theirs (`liftcore.solve.objects`)
    label     splats     the object of each splat, and its weight in other regions and in views
    share     views      the consensus of other views about their entries (`liftcore.solve.consensus`)
    compare   splats     cosines of regions with the other views (`liftcore.solve.reweight`)
    solve     splats     X and confidence

A worker holds one piece: W of some views or of a block, in mapped files where it is large, and tables of size M, of
which those of codebooks and directions take at most TABLE_BYTES.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.pieces import Pieces, Shape, SomeRows, fill_rows, gather_rows, part_of, take_rows, values_of
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.closed_form import solve_rows
from liftcore.solve.consensus import (
    RegionGroups,
    SplatTuples,
    along_curve,
    memberships,
    region_shares,
    splat_tuples,
    with_mean,
)
from liftcore.solve.directions import RegionDirections, region_totals
from liftcore.solve.objects import (
    count_members,
    node_containers,
    node_labels,
    node_shares,
    sample_splats,
    view_shares,
)
from liftcore.solve.region_tree import RegionTree
from liftcore.solve.reweight import BlockReweighter, SceneConsistency, confidence_of, scale_weights
from liftcore.solve.sums import PieceSums
from liftcore.values.region_weights import RegionWeights

Saved = tuple[dict[str, Any], Iterable[PieceSums], Shape | None]  # the arguments of `Pieces.save` after the number
Step = Callable[[Any, int, int | None], None]  # of `Pieces`


def saved_as(name: str) -> Callable[[Callable[[Any, int, int | None], Saved]], Step]:
    """Decorate a step: save what it computes of a piece by a name, unless that is done."""

    def decorate(compute: Callable[[Any, int, int | None], Saved]) -> Step:
        @wraps(compute)
        @one_thread()
        def work(pieces: Pieces, piece: int, threads: int | None) -> None:
            step = name.format(pieces.turn)
            if not pieces.has(step, piece):
                pieces.save(step, piece, *compute(pieces, piece, threads))

        return work

    return decorate


def groups_of(pieces: Pieces) -> RegionGroups:
    """Return the view and the level of each region."""
    table = pieces.load("regions")
    return RegionGroups.of(table["offsets"], table["levels"])


def weights_of(starts: np.ndarray, region: Tensor, weight: Tensor, offsets: np.ndarray) -> RegionWeights:
    """Make W, a row for each of ``starts``, without total weight."""
    rows, begins = torch.arange(starts.size - 1, dtype=torch.int32), torch.from_numpy(starts)
    return RegionWeights(rows, begins, region, weight, rows[:0], weight[:0], torch.from_numpy(offsets))


# ---- pieces of views


class ViewBlock(NamedTuple):
    """The splats of a piece of views, and W of these views."""

    base: int  # the first of their regions
    splats: np.ndarray  # [n] i32 ascending
    W: RegionWeights  # a row for each; regions are numbered over all views


def view_block(pieces: Pieces, piece: int) -> ViewBlock:
    """Load W of a piece of views."""
    arrays, numbers, offsets = (
        pieces.load("weights", piece),
        pieces.views_of(piece),
        pieces.load("regions")["offsets"],
    )
    base, region = int(offsets[numbers.start]), torch.from_numpy(arrays["region"])
    if base:
        region = values_of(region.shape[0], torch.int32)
        np.add(arrays["region"], np.int32(base), out=region.numpy())
    local_offsets = offsets[numbers.start : numbers.stop + 1] - base
    W = weights_of(arrays["starts"], region, torch.from_numpy(arrays["weight"]), local_offsets)
    return ViewBlock(base, arrays["splats"], W)


@saved_as("relate")
def relate(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the memberships and tuples of the splats of some views, and the count of splats in their regions."""
    block, groups = view_block(pieces, piece), groups_of(pieces)
    own_region = memberships(block.W, groups, threads)
    lengths = np.diff(block.W.indptr.numpy())
    rows = np.flatnonzero(lengths)
    rows = rows[along_curve(pieces.means[torch.from_numpy(block.splats[rows]).long()])]  # so that tuples repeat
    tuples = splat_tuples(block.W, own_region, groups, rows)
    lengths[rows] = np.diff(tuples.starts)
    _, numbers = take_rows(tuples.starts, np.argsort(rows), tuples.tuples)
    sizes = np.zeros(int(block.W.offsets[-1]), np.int64)
    count_members(block.W.region.numpy(), own_region, block.base, sizes)
    arrays = {"splats": block.splats, "own_region": own_region, "sizes": sizes, "tuples": numbers}
    arrays |= {"starts": np.concatenate([[0], np.cumsum(lengths)])}
    return arrays | {"parents": tuples.parents, "members": tuples.members}, (), None


def tuples_of(pieces: Pieces, splats: np.ndarray) -> tuple[SplatTuples, np.ndarray]:
    """Load the tuples of some splats [n] ascending in all views, and their totals t_j [n] f64."""
    ends = np.searchsorted(
        splats, [pieces.bounds(block)[0] for block in range(pieces.splat_pieces)] + [pieces.splats]
    )
    starts, totals = np.zeros(splats.size + 1, np.int64), np.zeros(splats.size)
    for target in (None, "filled"):
        tuples = values_of(int(starts[-1]) if target else 0, torch.int32).numpy()
        for block, (first, last) in enumerate(pairwise(ends.tolist())):
            if first == last:
                continue
            arrays, rows = pieces.load("join", block), splats[first:last] - pieces.bounds(block)[0]
            if target is None:
                starts[first + 1 : last + 1] = np.diff(arrays["starts"])[rows]
                totals[first:last] = arrays["totals"][rows]
            else:
                tuples[starts[first] : starts[last]] = take_rows(arrays["starts"], rows, arrays["tuples"])[1]
        if target is None:
            np.cumsum(starts, out=starts)
    table = pieces.load("tuples")
    return SplatTuples(starts, tuples, table["parents"], table["members"]), totals


@saved_as("contain")
def contain(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the nodes that contain those of some views."""
    block, groups, nodes = view_block(pieces, piece), groups_of(pieces), pieces.load("nodes")["nodes"]
    related = pieces.load("relate", piece)
    begins, rows = sample_splats(block.W, related["own_region"], related["sizes"], nodes, block.base)
    is_sampled = np.zeros(block.splats.size, np.bool_)
    is_sampled[rows] = True
    local, numbers = np.flatnonzero(is_sampled), (np.cumsum(is_sampled) - 1)[rows]
    tuples, totals = tuples_of(pieces, block.splats[local])
    return {"container": node_containers(begins, numbers, tuples, totals, nodes, groups, threads)}, (), None


@saved_as("share")
def share(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the consensus of other views about the entries of some views."""
    block, groups, own_region = (
        view_block(pieces, piece),
        groups_of(pieces),
        pieces.load("relate", piece)["own_region"],
    )
    visible = np.flatnonzero(np.diff(block.W.indptr.numpy()))
    bounds = torch.from_numpy(pieces.load("curve")["bounds"])
    order = along_curve(pieces.means[torch.from_numpy(block.splats[visible]).long()], bounds)
    tuples, totals = tuples_of(pieces, block.splats[visible])
    tuples = SplatTuples(*take_rows(tuples.starts, order, tuples.tuples), tuples.parents, tuples.members)
    arguments = block.W, own_region, groups, visible[order], totals[order], tuples
    sums, views, share_sum = region_shares(*arguments, base=block.base, threads=threads)
    arrays = {"splats": block.splats, "starts": block.W.indptr, "sums": sums, "views": views}
    return arrays | {"shares": np.array([share_sum, views.sum(dtype=np.int64)])}, (), None


# ---- blocks of splats


class SplatBlock(NamedTuple):
    """W of a block of splats in all views."""

    W: RegionWeights
    means: Tensor  # [n, 3]


def row_arrays(pieces: Pieces, W: RegionWeights, means: Tensor, total_weight: Tensor, threads: int | None) -> Saved:
    """Return what is saved of W of a block: its sums, total weight, bounds and, if read later, weights of regions."""
    sums, visible = W.row_sums(), means[W.indptr.diff() > 0]
    arrays = {"indptr": W.indptr, "region": W.region, "weight": W.weight, "sums": sums, "total_weight": total_weight}
    ends = [visible.amin(dim=0), visible.amax(dim=0)] if visible.numel() else []
    arrays["bounds"] = torch.stack(ends).double() if ends else torch.zeros(0, 3, dtype=torch.float64)
    if not (pieces.settings.robust or pieces.settings.objects):
        return arrays, (), None
    return arrays, region_totals(W, threads), (1, int(W.offsets[-1]))


def splat_block(pieces: Pieces, piece: int) -> SplatBlock:
    """Load W of a block of splats."""
    arrays = pieces.load("rows", piece)
    region, weight = (torch.from_numpy(arrays[name]) for name in ("region", "weight"))
    W = weights_of(arrays["indptr"], region, weight, pieces.load("regions")["offsets"])
    return SplatBlock(W, pieces.means[slice(*pieces.bounds(piece))])


@saved_as("join")
def join(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the tuples of a block of splats in all views, and the sums of its rows of W."""
    bases, (first, last) = pieces.load("tuples")["bases"], pieces.bounds(piece)

    def parts(begin: int, end: int) -> Iterator[SomeRows]:
        for number, base in enumerate(bases):
            arrays = pieces.load("relate", number)
            yield part_of(arrays["splats"], arrays["starts"], [arrays["tuples"]], (first + begin, first + end), base)

    starts, (tuples,) = gather_rows(parts, last - first, (torch.int32,), threads)
    return {"starts": starts, "tuples": tuples, "totals": pieces.load("rows", piece)["sums"]}, (), None


@saved_as("labels-{}")
def label(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the smallest node of each splat, and the weight of nodes: at first in other regions, then in views."""
    W, groups, tree = splat_block(pieces, piece).W, groups_of(pieces), RegionTree(**_tree(pieces))
    labels, number = node_labels(W, groups, tree, threads), tree.parents.size
    if pieces.turn == 0:
        other_masks = pieces.load("nodes")["other_masks"]
        return {"labels": labels}, node_shares(W, labels, number, other_masks, threads), None
    return {"labels": labels}, view_shares(W, groups, labels, number, threads), (1, number * groups.views)


def _tree(pieces: Pieces) -> dict[str, Any]:
    names = "region", "parents", "confidence"
    return {name: pieces.load(f"tree-{pieces.turn}")[name] for name in names}


def compared_levels(pieces: Pieces) -> np.ndarray:
    """Return the level in which each region is compared [M] i8, from 0 on; the same for all if none is apart."""
    levels = pieces.load("regions")["levels"]
    numbers = np.unique(levels, return_inverse=True)[1].astype(np.int8)
    return numbers if pieces.levels_apart else np.zeros_like(numbers)


@saved_as("cosines")
def compare(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save the cosines of regions with the other views, and their sums over the scene."""
    block, levels = splat_block(pieces, piece), pieces.load("regions")["levels"]
    reweighter = BlockReweighter(block.W, compared_levels(pieces), block.means, threads)
    cosines, sums = reweighter.cosines(_directions(pieces), by_region=bool((levels >= 0).any()))
    return {"cosines": cosines}, sums, reweighter.shape


def _directions(pieces: Pieces) -> RegionDirections:
    arrays = pieces.load("directions")
    parts = {name: torch.from_numpy(arrays[name]) for name in ("mean", "distances", "axes") if name in arrays}
    return RegionDirections(pieces.codebook, **parts)


def reweighted(
    pieces: Pieces, piece: int, block: SplatBlock, threads: int | None
) -> tuple[RegionWeights, Tensor | None]:
    """Compute W of a block after the robust step, and the confidence of splats [n]; None without the step."""
    if not pieces.settings.robust:
        return block.W, None
    scores, consensus = np.zeros((2, block.means.shape[0])), consensus_of(pieces, piece, block.W, threads)
    factors, facts = pieces.writable(pieces.load("cosines", piece)["cosines"]), pieces.load("consistency")
    consistency = SceneConsistency(*(facts[name] for name in ("mean_cosines", "powers", "regions")))
    BlockReweighter(block.W, compared_levels(pieces), None, threads).weigh(factors, consistency, consensus, scores)
    return scale_weights(block.W, factors), confidence_of(scores)


def consensus_of(pieces: Pieces, piece: int, W: RegionWeights, threads: int | None) -> Tensor | None:
    """Compute c_jm of the entries of a block [nnz] f32; None if no view has masks."""
    if pieces.usual_share is None:
        return None
    if pieces.view_pieces == pieces.splat_pieces == 1:  # the entries are in this order
        arrays = pieces.load("share", 0)
        sums, views = pieces.writable(arrays["sums"]), torch.from_numpy(arrays["views"])
    else:
        sums, views = (values_of(W.region.shape[0], dtype) for dtype in (torch.float32, torch.uint8))
        files = (pieces.load("share", number) for number in range(pieces.view_pieces))
        parts = (
            part_of(arrays["splats"], arrays["starts"], (arrays["sums"], arrays["views"]), pieces.bounds(piece))
            for arrays in files
        )
        fill_rows(parts, W.indptr.numpy(), [sums.numpy(), views.numpy()])
    with_mean(sums.numpy(), views.numpy(), pieces.usual_share, threads)
    return sums


@saved_as("columns")
def solve(pieces: Pieces, piece: int, threads: int | None) -> Saved:
    """Save X of a block of splats, and their confidence."""
    block = splat_block(pieces, piece)
    W, confidence = reweighted(pieces, piece, block, threads)
    sums, means = None if W is not block.W else torch.from_numpy(pieces.load("rows", piece)["sums"]), block.means
    del block
    pieces.drop("rows", "weights", "share", "cosines")  # in memory W is now that of the solve alone
    X = pieces.new_features(piece)
    solve_rows(X, W, pieces.codebook, sums=sums, means=means, threads=threads)
    pieces.save_features(piece, X)
    return {} if confidence is None else {"confidence": confidence}, (), None
