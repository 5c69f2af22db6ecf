"""The driver of a lift in blocks, for scenes whose W or X does not fit one machine.

An engine runs the steps (`lifting.engines.steps`). The driver adds up their sums over the scene, and writes the
totals for all workers. It holds tables of size M, a few columns of the splats, and the graph of objects; it
copies codebooks a view at a time.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.io.safetensors_file import map_tensors, write_tensors
from liftcore.io.shards import ROWS, map_rows, shard_at, write_index
from liftcore.lifting.base import LiftSteps, SplatSupport, WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import steps
from liftcore.lifting.engines.base import Engine, LocalEngine
from liftcore.lifting.engines.blocks import PIECE_VIEWS, SCENE, SELECTED, Job, read_view, weigh, write_scene
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.query.result import LiftResult, load_lift
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.solve.consensus import mean_share
from liftcore.solve.diagnostics import ViewMeasures, join_measures, measure_view
from liftcore.solve.directions import RegionDirections
from liftcore.solve.objects import (
    NodeVectors,
    RegionObjects,
    add_regions,
    choose_nodes,
    node_numbering,
    number_objects,
)
from liftcore.solve.region_tree import RegionTree, region_tree
from liftcore.solve.reweight import SceneConsistency, level_numbers, mask_regions
from liftcore.solve.sums import sum_pieces, unpack_sums
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import NO_ROOM, Views, write_pack
from liftcore.values.region_weights import MEMORY_LIMIT, MOST_REGIONS

if TYPE_CHECKING:
    from liftcore.lifting.engines.base import Work

PACKED = 64  # views of a pack
PIECES = re.compile("blocks-[0-9a-f]{64}")  # the folder of the pieces of one lift
PACKAGES = ("lifting", "raster", "scene", "solve", "values")  # whose code computes pieces


@contextmanager
def steps_in_blocks(
    engine: Engine,
    inputs: LiftInputs,
    timings: Timings,
    folder: Path | None = None,
    *,
    threads: int | None = None,
    rows: int = ROWS,
    selected: int = SELECTED,
) -> Iterator[InBlocks]:
    """Open the steps of a lift by an engine, where each piece is a file in a folder.

    Args:
        folder: that all workers share. An interrupted lift of packs resumes from the pieces there; None: a temporary
            folder.
        threads: of the driver; those of pieces are the engine's. None uses the cores that this process may use.
        rows: splats of a block, whole pages of X. selected: splats of scenes that workers load as a whole.

    Raises:
        InvalidSettings: engine is of another type; or a step needs all rays or all features, as in
            `LiftSettings.check_blocks`.
        Unavailable: the disk of the folder is full, or workers cannot read it.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    inputs.settings.check_blocks()
    with _folder(folder or engine.scratch, permanent=folder is not None) as place, _in_words(place), one_thread():
        try:
            yield InBlocks(engine, place, inputs, timings, threads, rows, selected)
        finally:
            steps.forget_files()


def plan_of_a_worker(plan: Plan) -> Plan:
    """Replace the memory of a plan by the estimate for one worker: bytes of each part at its peak."""
    splats, views = min(1.0, ROWS / plan.splats), min(1.0, PIECE_VIEWS / len(plan.views))
    splat_share = min(1.0, max(SELECTED, plan.splats_a_view) / plan.splats)
    shares = {"splats": splat_share, "scene": splat_share, "features": splats}
    # Some of their steps work on blocks of views, some on blocks of splats.
    shares |= dict.fromkeys(("objects", "reweighting"), max(views, splats))
    weights = {share: min(int(share * plan.weight_bytes), MEMORY_LIMIT) for share in (views, splats)}
    phases = dict[str, dict[str, int]]()
    for phase, parts in plan.memory_phases.items():
        phases[phase] = {name: int(size * shares.get(name, 1.0)) for name, size in parts.items()}
        phases[phase]["weights"] = weights[views if phase in ("geometry", "gather") else splats]
    phases["gather"]["gathered"] = weights[splats]
    return replace(plan, memory_phases=phases, weight_bytes=0)


@contextmanager
def _folder(folder: Path | None, *, permanent: bool) -> Iterator[Path]:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    if folder is not None and permanent:
        yield folder.resolve()
        return
    with scratch_folder("splatlift-blocks-", folder) as scratch:
        yield scratch.resolve()


def _lack_of_disk(folder: Path, plan: Plan) -> list[str]:
    """Return a warning if the disk is too small for W by views, W by splats and X, else none."""
    size, free = 2 * plan.weight_bytes + plan.memory_phases["solve"]["features"], shutil.disk_usage(folder).free
    if free >= size:
        return []
    shortage = f"blocks of about {size / 2**30:.1f} GiB go to {folder}, and there is {free / 2**30:.1f} GiB of disk"
    return [f"{shortage}: give a checkpoint folder with more room"]


@contextmanager
def _in_words(folder: Path) -> Iterator[None]:
    """Turn errors of a full disk, or of a folder that workers cannot read, into Unavailable with a hint."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            expected, got = f"room for blocks in {folder}", error.strerror or str(error)
            hint = "free space there, and the same lift resumes; or give a checkpoint folder on a larger disk"
        elif isinstance(error, FileNotFoundError) and str(folder) in str(error):
            expected, got = "a folder that all workers see under one path", f"one without {_missing(error, folder)}"
            hint = f"mount {folder} on all nodes, or give a checkpoint folder that is"
        else:
            raise
        raise Unavailable("checkpoint", expected=expected, got=got, hint=hint) from error


def _missing(error: FileNotFoundError, folder: Path) -> str:
    return Path(error.filename).name if error.filename else str(error).replace(f"{folder}/", "")


def _packs(views: Views, unpaired: set[str], folder: Path) -> list[Path]:
    """Write views that are in no pack into packs, from which workers read them."""
    names = [name for name in views if name not in unpaired]
    packs = []
    for number, begin in enumerate(range(0, len(names), PACKED)):
        packs.append(folder / f"views-{number:05}.safetensors")
        metadata = {"encoder": views.encoder, "text_space": views.text_space}
        write_pack(packs[-1], views.only(names[begin : begin + PACKED]), metadata)
    return packs


def _identity(job: Job, splats: Splats) -> str:
    """Return the digest, in hex, of all that pieces depend on; it is unique if views are in no pack."""
    facts = choose_device(job.settings.device).facts()
    depends = [Checkpoint(job.folder).of(splats, facts, PACKAGES).identity, job.settings.model_dump_json()]
    depends += [job.names, job.rows, job.kernel, [_facts(camera) for camera in job.cameras.values()]]
    packs = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in job.packs]
    return hashlib.sha256(json.dumps([*depends, packs or secrets.token_hex()]).encode()).hexdigest()


def _open_pieces(folder: Path, identity: str) -> Path:
    """Open the folder of a lift's pieces; delete those of other lifts, and unfinished files of workers that died.

    Each lift has a folder of its own, so that a worker of a killed lift cannot write into another lift's files.
    """
    pieces = folder / f"blocks-{identity}"
    for other in folder.glob("blocks-*"):
        if other != pieces and PIECES.fullmatch(other.name):
            shutil.rmtree(other, ignore_errors=True)
    pieces.mkdir(exist_ok=True)
    for draft in pieces.rglob(".*.part"):
        draft.unlink(missing_ok=True)
    return pieces


def _facts(camera: Camera) -> list[Any]:
    size = camera.width, camera.height
    return [camera.name, *size, camera.K.tolist(), camera.viewmat.tolist(), repr(camera.lens)]


class InBlocks(LiftSteps[Job]):
    """The steps by an engine; see the protocol. W is a job, which names its files, and X is mapped from shards."""

    def __init__(
        self,
        engine: Engine,
        folder: Path,
        inputs: LiftInputs,
        timings: Timings,
        threads: int | None,
        rows: int,
        selected: int,
    ) -> None:
        self.engine, self.folder, self.inputs, self.timings = engine, folder, inputs, timings
        self.threads, self.rows, self.selected = threads, rows, selected

    def run(self, stage: str, work: Work, job: Job, pieces: int) -> None:
        """Run a step for all pieces, and report progress."""
        for completed, _ in enumerate(self.engine.run(work, job, pieces), start=1):
            self.timings.progress(stage, completed, pieces, "blocks")

    def plan(self, views: LiftViews, device: Device) -> Plan:
        probe = bool(views.features.paths)
        if self.inputs.settings.device == "auto" and not isinstance(self.engine, LocalEngine):
            device = CPU  # workers may have other GPUs than this machine, or none
        return plan_lift(
            self.inputs.splats, views, self.inputs.settings, device, self.threads, in_workers=True, probe=probe
        )

    def weigh(self, views: LiftViews, plan: Plan, on_plan: Callable[[Plan], None]) -> tuple[Job, WeightStatistics]:
        worker_plan = plan_of_a_worker(plan)
        on_plan(replace(worker_plan, warnings=(*worker_plan.warnings, *_lack_of_disk(self.folder, plan))))
        with self.timings.step("share"):
            job = self._share(views, plan)
        for completed, _ in enumerate(self.engine.run(weigh, job, job.view_pieces), start=1):
            self.timings.progress("geometry", min(completed * PIECE_VIEWS, len(job.names)), len(job.names), "views")
        with self.timings.stage("gather"):
            statistics, settings = _share_regions(job, plan), job.settings
            dtype = getattr(torch, settings.dtype)
            if dtype == torch.float16 and not steps.codebook_of(job).fits_float16():
                dtype = torch.float32
            related = settings.finds_objects(statistics.masks) or (settings.robust and statistics.masks)
            job = replace(job, dtype=dtype, related=related)
            self._gather(job)
        return job, statistics

    def _share(self, views: LiftViews, plan: Plan) -> Job:
        """Write the job's inputs for all workers, which all use the device of the plan."""
        splats, source = self.inputs.splats, self.inputs.source_views
        settings = self.inputs.settings.model_copy(update={"device": plan.device.kind})
        packs = tuple(Path(path).resolve() for path in source.paths)
        sizes = splats.count, views.features.channels
        job = Job(self.folder, packs, views.cameras, views.names, settings, splats.kernel, *sizes)
        job = replace(job, rows=self.rows, selected=self.selected)
        job = replace(job, folder=_open_pieces(self.folder, _identity(job, splats)))
        if not (job.folder / SCENE).exists():
            write_scene(splats, job.folder / SCENE)
        return job if packs else replace(job, packs=tuple(_packs(source, set(views.unpaired), job.folder)))

    def _gather(self, job: Job) -> None:
        """Gather W by blocks of splats, and write the bounds of the curve that orders splats in space."""
        if job.related:
            self.run("gather", steps.relate, job, job.view_pieces)
            sizes, groups = _share_tuples(job), steps.groups_of(job)
            if job.settings.finds_objects(True):
                nodes, other_masks = choose_nodes(groups, sizes)
                steps.write_piece(job.folder / steps.NODES, {"nodes": nodes, "other_masks": other_masks})
        self.run("gather", steps.gather, job, job.splat_pieces)
        bounds = np.concatenate([part["bounds"] for part in _pieces(job, "rows")])
        if bounds.size:
            bounds = np.stack([bounds.min(axis=0), bounds.max(axis=0)])
        steps.write_piece(job.folder / steps.CURVE, {"bounds": bounds})

    def find_objects(self, W: Job) -> RegionObjects:
        groups = steps.groups_of(W)
        nodes, other_masks = (map_tensors(W.folder / steps.NODES)[0][name] for name in ("nodes", "other_masks"))
        self.run("objects", steps.contain, W, W.view_pieces)
        parts = [map_tensors(W.piece_file("contain", number))[0] for number in range(W.view_pieces)]
        containers = np.concatenate([part["container"] for part in parts])
        tree = region_tree(nodes, groups, containers, self.threads)
        number = tree.parents.size
        if number and other_masks.size:
            self._label(W, 0, tree)
            tree = add_regions(
                tree, other_masks, (part for file in _pieces(W, "labels-0") for part in unpack_sums(file))
            )
        self._label(W, 1, tree)
        labels, total_weight = _column(W, "labels-1", "labels"), _column(W, "rows", "total_weight")
        weights = _sums(W, "labels-1", (1, number * groups.views))
        numbers = node_numbering(labels, total_weight, tree)
        return number_objects(labels, tree, numbers, weights.reshape(number, groups.views))

    def _label(self, job: Job, step: int, tree: RegionTree) -> None:
        steps.write_piece(job.folder / steps.TREE.format(step), vars(tree))
        self.run("objects", steps.label, replace(job, step=step), job.splat_pieces)

    def node_vectors(self, W: Job, objects: RegionObjects) -> NodeVectors:
        codebook = steps.codebook_of(W)
        return NodeVectors.of(codebook, _sums(W, "rows", (1, codebook.regions))[0], objects)

    def compare_masks(self, W: Job) -> Job:
        self.run("consensus", steps.share, W, W.view_pieces)
        parts = [map_tensors(W.piece_file("share", number))[0]["shares"] for number in range(W.view_pieces)]
        share_sum, share_count = np.sum(parts, axis=0)
        return replace(W, usual_share=mean_share(int(share_sum), int(share_count)))

    def reweight(self, W: Job, levels_apart: bool) -> tuple[Job, float | None]:
        """See the protocol; the solve of each block applies the factors."""
        W = replace(W, levels_apart=levels_apart)
        codebook = steps.codebook_of(W)
        region_mask = mask_regions(steps.mapped(W.folder / steps.REGIONS)["levels"])
        totals = _sums(W, "rows", (1, codebook.regions))
        entries = sum(part["region"].size for part in _pieces(W, "rows"))
        principal = W.settings.robust_directions
        RegionDirections(codebook, torch.from_numpy(totals[0]), entries, principal).save(W.folder)
        level = level_numbers(steps.compared_levels(W), codebook.regions)
        shape = 2, codebook.regions + int(level.max(initial=0)) + 1
        self.run("robust", steps.compare, replace(W, by_region=region_mask is not None), W.splat_pieces)
        scene = SceneConsistency.of(_sums(W, "cosines", shape), region_mask, level)
        steps.write_scene_consistency(W, scene)
        return W, scene.reliability

    def solve(self, W: Job) -> tuple[Tensor, SplatSupport]:
        self.run("solve", steps.solve, W, W.splat_pieces)
        sums, total_weight = _column(W, "rows", "sums"), _column(W, "rows", "total_weight")
        confidence = torch.from_numpy(_column(W, "columns", "confidence")) if W.settings.robust else None
        return _mapped(W, W.features_file), SplatSupport(sums, torch.from_numpy(total_weight), confidence)

    def compare_with_optimum(self, W: Job, X: Tensor, visible: np.ndarray) -> NoReturn:
        """See the protocol; `LiftSettings.check_blocks` rejects settings that need it."""
        raise AssertionError("the optimum needs all rays in one place")

    def smooth(self, W: Job, X: Tensor, support: SplatSupport) -> NoReturn:
        """See the protocol; `LiftSettings.check_blocks` rejects settings that need it."""
        raise AssertionError("the graph of neighbours crosses blocks")

    def aggregate(self, W: Job, X: Tensor) -> NoReturn:
        """See the protocol; `LiftSettings.check_blocks` rejects settings that need it."""
        raise AssertionError("clusters need all features in one place")

    def measure(self, W: Job, X: Tensor) -> ViewMeasures:
        """See the protocol: a view at a time."""
        views = (read_view(W.view_file(number)) for number in range(len(W.names)))
        return join_measures([measure_view(view.sample, X, view.codebook.rows) for view in views])

    def deliver(self, W: Job, lift: LiftResult) -> LiftResult:
        """See the protocol: a lift mapped from shards; their files may be deleted while it is open."""
        columns = {name: part for name, part in vars(lift).items() if isinstance(part, Tensor) and name != "features"}
        write_index(W.folder / "lift", columns, W.splat_pieces, lift.metadata.model_dump_json())
        return load_lift(W.folder / "lift")


def _pieces(job: Job, step: str) -> Iterator[dict[str, np.ndarray]]:
    """Iterate over the files of a step for blocks of splats, one mapped at a time."""
    return (map_tensors(job.piece_file(step, number))[0] for number in range(job.splat_pieces))


def _sums(job: Job, step: str, shape: tuple[int, int]) -> np.ndarray:
    """Add up the sums in the files of a step."""
    return sum_pieces((part for arrays in _pieces(job, step) for part in unpack_sums(arrays)), shape)


def _column(job: Job, step: str, name: str) -> np.ndarray:
    """Concatenate a column of all splats [P] from the files of a step."""
    return np.concatenate([part[name] for part in _pieces(job, step)])


def _mapped(job: Job, file: Callable[[int], Path]) -> Tensor:
    """Map X [P, F] from the files of blocks."""
    return torch.from_numpy(map_rows([shard_at(file(number)) for number in range(job.splat_pieces)]))


def _share_regions(job: Job, plan: Plan) -> WeightStatistics:
    """Write the numbers of regions and the codebook of all views."""
    counts, levels, blind, entries = [0], list[np.ndarray](), list[str](), 0
    for number, name in enumerate(job.names):
        view = read_view(job.view_file(number))
        counts.append(view.codebook.regions)
        levels.append(view.levels.copy())
        entries += view.entries
        if view.blind:
            blind.append(name)
    arrays = {"offsets": np.cumsum(counts), "levels": np.concatenate(levels)}
    if arrays["offsets"][-1] > MOST_REGIONS:
        got, hint = f"{arrays['offsets'][-1]} in {len(job.names)} views", "lift fewer views, or smaller maps"
        raise Unavailable("features", expected=f"at most {MOST_REGIONS} regions", got=got, hint=hint)
    steps.write_piece(job.folder / steps.REGIONS, arrays)
    write_tensors(job.folder / steps.CODEBOOK, _Books(job), {})
    return WeightStatistics(plan, arrays["levels"], entries, tuple(blind))


class _Books(Mapping[str, Tensor]):
    """The codebooks of all views by names of their tensors, each read on access."""

    def __init__(self, job: Job) -> None:
        self._job, self._names = job, list[str]()
        for number in range(len(job.names)):
            tuples = read_view(job.view_file(number)).codebook.tuples
            self._names += [f"rows/{number}", *([] if tuples is None else [f"tuples/{number}"])]

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __getitem__(self, name: str) -> Tensor:
        part, number = name.split("/")
        return getattr(read_view(self._job.view_file(int(number))).codebook, part)


def _share_tuples(job: Job) -> np.ndarray:
    """Write the tables of all views' tuples; return the count of splats in each region, [M] i64."""
    bases, parents, members, sizes = [0], list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for number in range(job.view_pieces):
        part = map_tensors(job.piece_file("relate", number))[0]
        piece_parents = part["parents"]
        parents.append(np.where(piece_parents < 0, piece_parents, piece_parents + np.int32(bases[-1])))
        members.append(part["members"].copy())
        sizes.append(part["sizes"].copy())
        bases.append(bases[-1] + piece_parents.size)
    arrays = {"bases": np.array(bases[:-1]), "parents": np.concatenate(parents), "members": np.concatenate(members)}
    steps.write_piece(job.folder / steps.TUPLES, arrays)
    return np.concatenate(sizes)
