"""The steps of a lift in blocks after W of its views is computed; a piece is some views, or a block of splats.

A step is a function ``(job, piece, threads)`` that reads the files of earlier steps and writes one file atomically.
Sums over the scene are written per piece of splats (`liftcore.solve.sums`). The driver (`lifting.engines.lift`) adds
them up and writes the totals as files too. So the result is bitwise identical to that of a lift in memory.

    step      piece of   writes
    relate    views      the regions that their splats belong to, as tuples (`liftcore.solve.consensus`)
    gather    splats     W of all views, a row a splat, its sums and total weight; the tuples of all views
    contain   views      the regions that contain theirs (`liftcore.solve.objects`)
    label     splats     the object of each splat, and its weight in other regions and in views
    share     views      the consensus of other views about their entries (`liftcore.solve.consensus`)
    compare   splats     cosines of regions with the other views (`liftcore.solve.reweight`)
    solve     splats     X and confidence

A worker holds one piece: W of some views or of a block, in mapped files where it is large, and tables of size M, of
which those of codebooks and directions take at most TABLE_BYTES.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.io.safetensors_file import map_tensors, write_tensors
from liftcore.io.shards import write_rows
from liftcore.lifting.engines import blocks
from liftcore.lifting.engines.blocks import Job, file_version, read_weights, scene_of
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.closed_form import solve_rows
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.consensus import SplatTuples, along_curve, region_shares, splat_tuples, with_mean
from liftcore.solve.directions import StoredDirections, region_totals
from liftcore.solve.membership import RegionGroups, memberships
from liftcore.solve.objects import (
    node_containers,
    node_labels,
    node_shares,
    sampled_nodes,
    sampled_splats,
    view_shares,
)
from liftcore.solve.region_tree import RegionTree
from liftcore.solve.reweight import BlockReweighter, SceneConsistency, scale_weights
from liftcore.solve.rows import SomeRows, fill_rows, gather_rows, take_rows, values_of
from liftcore.solve.sums import PieceSums, pack_sums
from liftcore.values.region_weights import RegionWeights

if TYPE_CHECKING:
    from liftcore.lifting.engines.base import Work

# Files of the driver, of size M. No name is used twice, as other nodes may see an older file for some seconds.
REGIONS = "regions.safetensors"  # offsets [V + 1] i64, levels [M] i8
CODEBOOK = "codebook.safetensors"  # rows/v [M_v, F] and, where regions are tuples of rows, tuples/v [T_v, L] i32
TUPLES = "tuples.safetensors"  # bases [pieces] i64, parents and members [T] i32
CURVE = "curve.safetensors"  # bounds [2, 3] f64 of the splats with weight
NODES = "nodes.safetensors"  # nodes and other_masks, i64
TREE = "tree-{}.safetensors"  # of regions (`RegionTree`), by the step of `label`
SCENE_CONSISTENCY = "consistency.safetensors"  # regions [M] f32, mean_cosine and power [K] f64, reliability [1] f64


def mapped(path: Path) -> dict[str, Any]:
    """Map the arrays of a file, by name; again after the file is replaced."""
    return _mapped(path, file_version(path))


@lru_cache(maxsize=4)
def _mapped(path: Path, _version: tuple[int, int]) -> dict[str, np.ndarray]:
    return map_tensors(path)[0]


def codebook_of(job: Job) -> Codebook:
    """Map E of all views."""
    path = job.folder / CODEBOOK
    return _codebook(path, file_version(path), len(job.names))


@lru_cache(maxsize=1)
def _codebook(path: Path, _version: tuple[int, int], views: int) -> Codebook:
    tensors = {name: torch.from_numpy(array) for name, array in map_tensors(path)[0].items()}
    return Codebook([ViewCodebook(tensors[f"rows/{v}"], tensors.get(f"tuples/{v}")) for v in range(views)])


def forget_files() -> None:
    """Unmap the files of a lift: the disk frees the space of a deleted file only when nothing maps it."""
    for cache in (_mapped, _codebook, blocks.mapped_scene, blocks.packs_at):
        cache.cache_clear()


def offsets_of(job: Job) -> np.ndarray:
    """Return [V + 1] i64: the first region of each view."""
    return mapped(job.folder / REGIONS)["offsets"]


def groups_of(job: Job) -> RegionGroups:
    """Return the view and the level of each region."""
    return RegionGroups.of(offsets_of(job), mapped(job.folder / REGIONS)["levels"])


def write_piece(path: Path, arrays: dict[str, Any], sums: Sequence[PieceSums] = ()) -> None:
    """Write the arrays or tensors of a piece, and sums of its pieces of splats."""
    tensors = {name: part if isinstance(part, Tensor) else torch.from_numpy(part) for name, part in arrays.items()}
    write_tensors(path, tensors | (pack_sums(sums) if sums else {}), {})


Piece = tuple[dict[str, Any], Sequence[PieceSums]]  # arrays by name, and sums of its pieces of splats


def piece_of(step: str) -> Callable[[Callable[[Job, int, int | None], Piece]], Work]:
    """Decorate a step: write its arrays to the piece's file, unless that exists."""

    def decorate(find: Callable[[Job, int, int | None], Piece]) -> Work:
        @wraps(find)
        @one_thread()
        def work(job: Job, number: int, threads: int | None) -> None:
            path = job.piece_file(step.format(step=job.step), number)
            if not path.exists():
                write_piece(path, *find(job, number, threads))

        return work

    return decorate


# ---- blocks of views


class ViewBlock(NamedTuple):
    """The splats of a piece of views, and W of these views."""

    base: int  # the first of their regions
    splats: np.ndarray  # [n] i32 ascending
    W: RegionWeights  # a row for each; regions are numbered over all views


def _view_block(job: Job, piece: int) -> ViewBlock:
    block, numbers, offsets = read_weights(job, piece), job.views_of(piece), offsets_of(job)
    base = int(offsets[numbers.start])
    region = values_of(block.region.size, torch.int32)
    np.add(block.region, np.int32(base), out=region.numpy())
    local_offsets = offsets[numbers.start : numbers.stop + 1] - base
    return ViewBlock(
        base, block.splats, _weights(block.starts, region, torch.from_numpy(block.weight), local_offsets)
    )


def _weights(starts: np.ndarray, region: Tensor, weight: Tensor, offsets: np.ndarray) -> RegionWeights:
    """Make W, a row for each of ``starts``, without weight."""
    rows, begins = torch.arange(starts.size - 1, dtype=torch.int32), torch.from_numpy(starts)
    return RegionWeights(rows, begins, region, weight, rows[:0], weight[:0], torch.from_numpy(offsets))


@piece_of("relate")
def relate(job: Job, piece: int, threads: int | None) -> Piece:
    """Write the tuples of the splats of some views, and the count of splats in each of their regions."""
    block, groups = _view_block(job, piece), groups_of(job)
    own_region = memberships(block.W, groups, threads).own_region
    tuples = splat_tuples(block.W, own_region, groups, np.arange(block.splats.size))
    sizes = np.bincount(block.W.region.numpy()[own_region] - block.base, minlength=int(block.W.offsets[-1]))
    arrays = {"splats": block.splats, "sizes": sizes}
    arrays |= {name: getattr(tuples, name) for name in ("starts", "tuples", "parents", "members")}
    return arrays, ()


def _tuples_of(job: Job, splats: np.ndarray) -> tuple[SplatTuples, np.ndarray]:
    """Read the tuples of some splats [n] ascending in all views, and their totals t_j [n] f64."""
    ends = np.searchsorted(splats, np.arange(job.splat_pieces + 1) * job.rows)
    starts, totals = np.zeros(splats.size + 1, np.int64), np.zeros(splats.size)
    for target in (None, "filled"):
        tuples = values_of(int(starts[-1]) if target else 0, torch.int32).numpy()
        for block, (first, last) in enumerate(pairwise(ends.tolist())):
            if first == last:
                continue
            arrays, rows = map_tensors(job.piece_file("tuples", block))[0], splats[first:last] - block * job.rows
            if target is None:
                starts[first + 1 : last + 1] = np.diff(arrays["starts"])[rows]
                totals[first:last] = arrays["totals"][rows]
            else:
                tuples[starts[first] : starts[last]] = take_rows(arrays["starts"], rows, arrays["tuples"])[1]
        if target is None:
            np.cumsum(starts, out=starts)
    tables = mapped(job.folder / TUPLES)
    return SplatTuples(starts, tuples, tables["parents"], tables["members"]), totals


def _take_tuples(tuples: SplatTuples, rows: np.ndarray) -> SplatTuples:
    return SplatTuples(*take_rows(tuples.starts, rows, tuples.tuples), tuples.parents, tuples.members)


@piece_of("contain")
def contain(job: Job, piece: int, threads: int | None) -> Piece:
    """Write the nodes that contain those of some views."""
    block, groups, nodes = _view_block(job, piece), groups_of(job), mapped(job.folder / NODES)["nodes"]
    own_region = memberships(block.W, groups, threads).own_region
    begins, rows = sampled_splats(block.W, own_region, nodes, block.base)
    sampled = np.zeros(block.splats.size, np.bool_)
    sampled[rows] = True
    local, numbers = np.flatnonzero(sampled), (np.cumsum(sampled) - 1)[rows]
    tuples, totals = _tuples_of(job, block.splats[local])
    table = sampled_nodes(begins, numbers, tuples, totals, nodes, groups.view.size)
    return {"container": node_containers(table, nodes, groups, threads)}, ()


@piece_of("share")
def share(job: Job, piece: int, threads: int | None) -> Piece:
    """Write the consensus of other views about the entries of some views."""
    block, groups = _view_block(job, piece), groups_of(job)
    own_region, splats = memberships(block.W, groups, threads).own_region, torch.from_numpy(block.splats).long()
    bounds = torch.from_numpy(mapped(job.folder / CURVE)["bounds"])
    rows = along_curve(scene_of(job).means[splats], bounds)
    tuples, totals = _tuples_of(job, block.splats)
    tuples = _take_tuples(tuples, rows)
    shares = region_shares(block.W, own_region, groups, rows, totals[rows], tuples, base=block.base, threads=threads)
    arrays = {"splats": block.splats, "starts": block.W.indptr, "sums": shares.sums, "views": shares.views}
    return arrays | {"shares": np.array([shares.share_sum, shares.share_count])}, ()


# ---- blocks of splats


def _bounds(job: Job, piece: int) -> tuple[int, int]:
    return piece * job.rows, min((piece + 1) * job.rows, job.splats)


def _part(splats: np.ndarray, starts: np.ndarray, values: Iterable[np.ndarray], ends: tuple[int, int]) -> SomeRows:
    """Select the rows of a part that are in a block, and their values."""
    first, last = np.searchsorted(splats, ends)
    span = slice(int(starts[first]), int(starts[last]))
    return SomeRows(
        splats[first:last] - ends[0], starts[first : last + 1] - span.start, [part[span] for part in values]
    )


def _weight_rows(job: Job, ends: tuple[int, int]) -> Iterator[SomeRows]:
    """Iterate over the rows of W of a block in each piece of views, with one file open at a time."""
    offsets = offsets_of(job)
    for piece in range(job.view_pieces):
        block, base = read_weights(job, piece), np.int32(offsets[job.views_of(piece).start])
        part = _part(block.splats, block.starts, (block.region, block.weight), ends)
        yield SomeRows(part.rows, part.starts, [part.values[0] + base, part.values[1]])


def _total_weight(job: Job, ends: tuple[int, int]) -> Tensor:
    """Sum the total weight of a block [n] f32 over views, in their order."""
    sums = np.zeros(ends[1] - ends[0])
    for piece in range(job.view_pieces):
        block = read_weights(job, piece)
        part = _part(block.total_weight_splats, block.total_weight_starts, (block.total_weight,), ends)
        np.add.at(sums, np.repeat(part.rows, np.diff(part.starts)), part.values[0].astype(np.float64))
    return torch.from_numpy(sums).float()


@piece_of("rows")
def gather(job: Job, piece: int, threads: int | None) -> Piece:
    """Write W of a block of splats in all views, its sums, total weight and tuples."""
    ends = first, last = _bounds(job, piece)
    starts, values = gather_rows(lambda: _weight_rows(job, ends), last - first, (torch.int32, torch.float32))
    W = _weights(starts, values[0], values[1], offsets_of(job))
    sums = W.row_sums()
    if job.related:
        _gather_tuples(job, piece, ends, sums)
    means = scene_of(job).means[first:last][W.indptr.diff() > 0].double()
    none = torch.zeros(0, 3, dtype=torch.float64)
    bounds = torch.stack([means.amin(dim=0), means.amax(dim=0)]) if means.numel() else none
    arrays = {"indptr": W.indptr, "region": W.region, "weight": W.weight, "sums": sums}
    needs_totals = job.settings.robust or job.settings.objects  # these read the weight of each region
    totals = list(region_totals(W, threads)) if needs_totals else []
    return arrays | {"total_weight": _total_weight(job, ends), "bounds": bounds}, totals


def _gather_tuples(job: Job, piece: int, ends: tuple[int, int], totals: Tensor) -> None:
    bases = mapped(job.folder / TUPLES)["bases"]

    def parts() -> Iterator[SomeRows]:
        for number, base in enumerate(bases):
            arrays = map_tensors(job.piece_file("relate", number))[0]
            part = _part(arrays["splats"], arrays["starts"], [arrays["tuples"]], ends)
            yield SomeRows(part.rows, part.starts, [part.values[0] + np.int32(base)])

    starts, (tuples,) = gather_rows(parts, ends[1] - ends[0], (torch.int32,))
    write_piece(job.piece_file("tuples", piece), {"starts": starts, "tuples": tuples, "totals": totals})


@dataclass(frozen=True)
class SplatBlock:
    """A block of splats, and W of these in all views."""

    first: int
    last: int
    W: RegionWeights
    means: Tensor  # [n, 3]
    arrays: dict[str, np.ndarray]  # of the file of `gather`


def _splat_block(job: Job, piece: int) -> SplatBlock:
    first, last = _bounds(job, piece)
    arrays = map_tensors(job.piece_file("rows", piece))[0]
    region, weight = (torch.from_numpy(arrays[name]) for name in ("region", "weight"))
    W = _weights(arrays["indptr"], region, weight, offsets_of(job))
    return SplatBlock(first, last, W, scene_of(job).means[first:last], arrays)


@piece_of("labels-{step}")
def label(job: Job, piece: int, threads: int | None) -> Piece:
    """Write the smallest node of each splat, and the weight of nodes: in step 0 in other regions, then in views."""
    block, tree = _splat_block(job, piece), RegionTree(**mapped(job.folder / TREE.format(job.step)))
    groups, number = groups_of(job), tree.parents.size
    labels = node_labels(block.W, groups, tree, threads)
    if job.step == 0:
        other_masks = mapped(job.folder / NODES)["other_masks"]
        sums = node_shares(block.W, labels, number, other_masks, threads)
    else:
        sums = view_shares(block.W, groups, labels, number, threads)
    return {"labels": labels}, list(sums)


def _consensus(job: Job, block: SplatBlock, threads: int | None) -> Tensor | None:
    """Compute c_jm of the entries of a block [nnz] f32; None if no view has masks."""
    if job.usual_share is None:
        return None
    sums, views = values_of(block.W.region.shape[0], torch.float32), values_of(block.W.region.shape[0], torch.uint8)
    ends = block.first, block.last

    def parts() -> Iterator[SomeRows]:
        for number in range(job.view_pieces):
            arrays = map_tensors(job.piece_file("share", number))[0]
            yield _part(arrays["splats"], arrays["starts"], (arrays["sums"], arrays["views"]), ends)

    fill_rows(parts(), block.W.indptr.numpy(), [sums.numpy(), views.numpy()])
    with_mean(sums.numpy(), views.numpy(), job.usual_share, threads)
    return sums


def scene_consistency(job: Job) -> SceneConsistency:
    """Read the driver's totals of the robust step."""
    arrays = map_tensors(job.folder / SCENE_CONSISTENCY)[0]
    mean_cosine, regions, power = (torch.from_numpy(arrays[name]) for name in ("mean_cosine", "regions", "power"))
    reliability = float(arrays["reliability"][0])
    return SceneConsistency(mean_cosine, regions, power, None if np.isnan(reliability) else reliability)


def write_scene_consistency(job: Job, scene: SceneConsistency) -> None:
    """Write the driver's totals of the robust step."""
    reliability = np.nan if scene.reliability is None else scene.reliability
    arrays = {"regions": scene.regions, "mean_cosine": scene.mean_cosine, "power": scene.power}
    arrays["reliability"] = torch.tensor([reliability], dtype=torch.float64)
    write_tensors(job.folder / SCENE_CONSISTENCY, arrays, {})


def _block_reweighter(job: Job, block: SplatBlock, threads: int | None) -> BlockReweighter:
    return BlockReweighter(block.W, block.means, threads, compared_levels(job))


def compared_levels(job: Job) -> np.ndarray | None:
    """Return [M] i8: the level of each region if levels are compared separately, else None."""
    return mapped(job.folder / REGIONS)["levels"] if job.levels_apart else None


@piece_of("cosines")
def compare(job: Job, piece: int, threads: int | None) -> Piece:
    """Write the cosines of regions with their sums over the scene."""
    block, sums = _splat_block(job, piece), list[PieceSums]()
    reweighter = _block_reweighter(job, block, threads)
    return {"cosines": reweighter.cosines(StoredDirections(job.folder), job.by_region, sums.append)}, sums


def _reweighted(job: Job, piece: int, block: SplatBlock, threads: int | None) -> tuple[RegionWeights, Tensor | None]:
    """Compute W of a block after the robust step, and the confidence of splats [n]; None without the step."""
    if not job.settings.robust:
        return block.W, None
    cosines = torch.from_numpy(map_tensors(job.piece_file("cosines", piece))[0]["cosines"])
    factors = values_of(cosines.shape[0], torch.float32).copy_(cosines)
    reweighter, consensus = _block_reweighter(job, block, threads), _consensus(job, block, threads)
    confidence = reweighter.weigh(factors, scene_consistency(job), consensus)
    return scale_weights(block.W, factors), confidence


@one_thread()
def solve(job: Job, piece: int, threads: int | None) -> None:
    """Write X of a block of splats, and their confidence."""
    columns_file, features_file = job.columns_file(piece), job.features_file(piece)
    if columns_file.exists() and features_file.exists():
        return
    block, codebook = _splat_block(job, piece), codebook_of(job)
    W, confidence = _reweighted(job, piece, block, threads)
    X = torch.zeros(block.last - block.first, job.channels, dtype=job.dtype)
    solve_rows(X, W, codebook, means=block.means, threads=threads)
    write_rows(features_file, X)
    write_piece(columns_file, {} if confidence is None else {"confidence": confidence})
