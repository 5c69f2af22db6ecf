"""A lift in blocks, of scenes whose W, or X, is more than one machine should hold: what the driver does.

It has the steps done by an engine (`lifting.engines.steps`), adds up what they found of the scene, and shares it. It
holds tables of the size of M, a column or two of the splats, and the graph of objects; codebooks it hands on, a view
at a time.
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
from liftcore.lifting.engines.blocks import SCENE, SELECTED, WEIGHED, Job, read_view, weigh, write_scene
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.query.result import LiftResult, load_lift
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.solve.aggregate import MASKS_MADE, Aggregation, aggregation_facts, cluster_means
from liftcore.solve.clusters import Clustering
from liftcore.solve.consensus import mean_share
from liftcore.solve.diagnostics import ViewMeasures, joined, measure_view
from liftcore.solve.directions import RegionDirections
from liftcore.solve.loss import mean_distance
from liftcore.solve.objects import (
    NodeVectors,
    RegionObjects,
    choose_nodes,
    node_numbering,
    numbered,
    with_others,
)
from liftcore.solve.region_tree import RegionTree, region_tree
from liftcore.solve.reweight import SceneAgreement, level_numbers, whole_regions
from liftcore.solve.sums import added, unpacked
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import NO_ROOM, Views, write_pack
from liftcore.values.region_weights import MOST_REGIONS

if TYPE_CHECKING:
    from liftcore.lifting.engines.base import Work

PACKED = 64  # views of a pack
PIECES = re.compile("blocks-[0-9a-f]{64}")  # the folder of the pieces of one lift
PACKAGES = ("lifting", "raster", "scene", "solve", "values")  # whose code makes pieces


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
    """The steps of a lift by an engine: each piece is a file in a folder. What needs all rays or features is refused.

    Args:
        folder: that all workers share. A lift of packs that was cut off goes on from the pieces there; None: one that
            is gone at the end.
        threads: of the driver's own work; the engine has those of pieces. None takes the cores that it may use.
        rows: splats that are solved together, whole pages of X. selected: splats of scenes that workers hold whole.

    Raises:
        InvalidSettings: it is no engine; or as `LiftSettings.check_blocks` has it.
        Unavailable: the folder has no room, or workers do not see it.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    views = inputs.views
    inputs.settings.check_blocks(any(views.features.is_regions(name) for name in views.names))
    with _folder(folder or engine.scratch, kept=folder is not None) as place, _in_words(place), one_thread():
        try:
            yield InBlocks(engine, place, inputs, timings, threads, rows, selected)
        finally:
            steps.forget_files()


def plan_of_a_worker(plan: Plan) -> Plan:
    """The plan of a lift in one place with what a worker takes: bytes of each part at its peak, about."""
    splats = min(1.0, ROWS / plan.splats)
    held = min(1.0, max(SELECTED, plan.splats_a_view) / plan.splats)
    shares = {"splats": held, "scene": held, "weights": min(1.0, WEIGHED / len(plan.views))}
    shares |= {"gathered": splats, "features": splats}
    memory = {name: int(size * shares.get(name, 1.0)) for name, size in plan.memory.items()}
    return replace(plan, memory=memory, weight_bytes=0)


@contextmanager
def _folder(folder: Path | None, *, kept: bool) -> Iterator[Path]:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    if folder is not None and kept:
        yield folder.resolve()
        return
    with scratch_folder("splatlift-blocks-", folder) as own:
        yield own.resolve()


def _lack_of_disk(folder: Path, plan: Plan) -> list[str]:
    """What to say where the folder has no room for W by views, W by splats and X: nothing, or a warning."""
    size, free = 2 * plan.weight_bytes + plan.memory["features"], shutil.disk_usage(folder).free
    if free >= size:
        return []
    there = f"blocks of about {size / 2**30:.1f} GiB go to {folder}, and there is {free / 2**30:.1f} GiB of disk"
    return [f"{there}: give a checkpoint folder with more room"]


@contextmanager
def _in_words(folder: Path) -> Iterator[None]:
    """Say what to do about a folder of pieces that is full, or that workers do not see."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            expected, got = f"room for blocks in {folder}", error.strerror or str(error)
            hint = "make room there, and the same lift goes on; or give a checkpoint folder on a larger disk"
        elif isinstance(error, FileNotFoundError) and str(folder) in str(error):
            expected, got = "a folder that all workers see under one path", f"one without {_missing(error, folder)}"
            hint = f"mount {folder} on all nodes, or give a checkpoint folder that is"
        else:
            raise
        raise Unavailable("checkpoint", expected=expected, got=got, hint=hint) from error


def _missing(error: FileNotFoundError, folder: Path) -> str:
    return Path(error.filename).name if error.filename else str(error).replace(f"{folder}/", "")


def _packs(given: Views, unpaired: set[str], folder: Path) -> list[Path]:
    """Views that lie in no pack, written into some: whoever works on a view reads it there, and pairs it anew."""
    names = [name for name in given if name not in unpaired]
    packs = []
    for number, begin in enumerate(range(0, len(names), PACKED)):
        packs.append(folder / f"views-{number:05}.safetensors")
        told = {"encoder": given.encoder, "text_space": given.text_space}
        write_pack(packs[-1], given.only(names[begin : begin + PACKED]), told)
    return packs


def _identity(job: Job, splats: Splats) -> str:
    """All that the pieces of a lift depend on, in hex. Views that lie in no pack are told from all others."""
    facts = choose_device(job.settings.device).facts()
    depends = [Checkpoint(job.folder).of(splats, facts, PACKAGES).identity, job.settings.model_dump_json()]
    depends += [job.names, job.rows, job.kernel, [_facts(camera) for camera in job.cameras.values()]]
    packs = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in job.packs]
    return hashlib.sha256(json.dumps([*depends, packs or secrets.token_hex()]).encode()).hexdigest()


def _open_pieces(folder: Path, identity: str) -> Path:
    """The folder of a lift's pieces, those of the same lift; other lifts' go, and drafts of workers that died.

    Each lift has a folder of its own: what a worker of a killed one still writes lies in no other's way.
    """
    own = folder / f"blocks-{identity}"
    for other in folder.glob("blocks-*"):
        if other != own and PIECES.fullmatch(other.name):
            shutil.rmtree(other, ignore_errors=True)
    own.mkdir(exist_ok=True)
    for draft in own.rglob(".*.part"):
        draft.unlink(missing_ok=True)
    return own


def _facts(camera: Camera) -> list[Any]:
    size = camera.width, camera.height
    return [camera.name, *size, camera.K.tolist(), camera.viewmat.tolist(), repr(camera.lens or camera.face)]


class InBlocks(LiftSteps[Job]):
    """Steps by an engine; see the protocol. W is a job, whose files have it, and X lies in shards that are mapped."""

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
        """Have a step done for all pieces."""
        for done, _ in enumerate(self.engine.run(work, job, pieces), start=1):
            self.timings.progress(stage, done, pieces, "blocks")

    def plan(self, views: LiftViews, device: Device) -> Plan:
        look = bool(views.features.paths)
        if self.inputs.settings.device == "auto" and not isinstance(self.engine, LocalEngine):
            device = CPU  # workers elsewhere may have other cards than this machine, or none
        return plan_lift(self.inputs.splats, views, self.inputs.settings, device, self.threads, apart=True, look=look)

    def weigh(self, views: LiftViews, plan: Plan, on_plan: Callable[[Plan], None]) -> tuple[Job, WeightStatistics]:
        own = plan_of_a_worker(plan)
        on_plan(replace(own, warnings=(*own.warnings, *_lack_of_disk(self.folder, plan))))
        with self.timings.step("share"):
            job = self._share(views, plan)
        for done, _ in enumerate(self.engine.run(weigh, job, job.weighings), start=1):
            self.timings.progress("geometry", min(done * WEIGHED, len(job.names)), len(job.names), "views")
        with self.timings.stage("gather"):
            weighed, settings = _share_regions(job, plan), job.settings
            dtype = getattr(torch, settings.dtype)
            if dtype == torch.float16 and not steps.codebook_of(job).fits_float16():
                dtype = torch.float32
            related = settings.finds_objects(weighed.masks) or settings.asks_consensus(weighed.masks)
            job = replace(job, dtype=dtype, related=related)
            self._gather(job)
        return job, weighed

    def _share(self, views: LiftViews, plan: Plan) -> Job:
        """Write what all workers read, who all take the device of the plan."""
        splats, given = self.inputs.splats, self.inputs.source_views
        settings = self.inputs.settings.model_copy(update={"device": plan.device.kind})
        packs = tuple(Path(path).resolve() for path in given.paths)
        sizes = splats.count, views.features.channels
        job = Job(self.folder, packs, views.cameras, views.names, settings, splats.kernel, *sizes)
        job = replace(job, rows=self.rows, selected=self.selected)
        job = replace(job, folder=_open_pieces(self.folder, _identity(job, splats)))
        if not (job.folder / SCENE).exists():
            write_scene(splats, job.folder / SCENE)
        return job if packs else replace(job, packs=tuple(_packs(given, set(views.unpaired), job.folder)))

    def _gather(self, job: Job) -> None:
        """W by blocks of splats, and what places of the curve mean."""
        if job.related:
            self.run("gather", steps.relate, job, job.weighings)
            sizes, groups = _share_tuples(job), steps.groups_of(job)
            if job.settings.finds_objects(True):
                nodes, others = choose_nodes(groups, sizes)
                steps.write_piece(job.folder / steps.NODES, {"nodes": nodes, "others": others})
        self.run("gather", steps.gather, job, job.solutions)
        bounds = np.concatenate([part["bounds"] for part in _pieces(job, "rows")])
        if bounds.size:
            bounds = np.stack([bounds.min(axis=0), bounds.max(axis=0)])
        steps.write_piece(job.folder / steps.CURVE, {"bounds": bounds})

    def find_objects(self, W: Job) -> RegionObjects:
        groups = steps.groups_of(W)
        nodes, others = (map_tensors(W.folder / steps.NODES)[0][name] for name in ("nodes", "others"))
        self.run("objects", steps.contain, W, W.weighings)
        parts = [map_tensors(W.piece_file("contain", number))[0] for number in range(W.weighings)]
        containers = np.concatenate([part["container"] for part in parts])
        tree = region_tree(nodes, groups, containers, self.threads)
        number = tree.parents.size
        if number and others.size:
            self._label(W, 0, tree)
            tree = with_others(tree, others, (part for file in _pieces(W, "labels-0") for part in unpacked(file)))
        self._label(W, 1, tree)
        labels, evidence = _column(W, "labels-1", "labels"), _column(W, "rows", "evidence")
        shown = _sums(W, "labels-1", (1, number * groups.views))
        numbers = node_numbering(labels, evidence, tree)
        steps.write_piece(W.folder / steps.OBJECTS, {"object": numbers.object})
        return numbered(labels, tree, numbers, shown.reshape(number, groups.views))

    def _label(self, job: Job, step: int, tree: RegionTree) -> None:
        steps.write_piece(job.folder / steps.TREE.format(step), vars(tree))
        self.run("objects", steps.label, replace(job, step=step), job.solutions)

    def node_vectors(self, W: Job, objects: RegionObjects) -> NodeVectors:
        codebook = steps.codebook_of(W)
        return NodeVectors.of(codebook, _sums(W, "rows", (1, codebook.regions))[0], objects)

    def compare_masks(self, W: Job) -> Job:
        self.run("consensus", steps.share, W, W.weighings)
        parts = [map_tensors(W.piece_file("share", number))[0]["told"] for number in range(W.weighings)]
        told, asked = np.sum(parts, axis=0)
        return replace(W, usual_share=mean_share(int(told), int(asked)))

    def reweight(self, W: Job, levels_apart: bool) -> tuple[Job, float | None]:
        """See the protocol: all but the last step's factors, which blocks take when they are solved."""
        W = replace(W, levels_apart=levels_apart)
        codebook = steps.codebook_of(W)
        whole = whole_regions(W.settings.reliability, steps.mapped(W.folder / steps.REGIONS)["levels"])
        totals = _sums(W, "rows", (1, codebook.regions))
        entries = sum(part["region"].size for part in _pieces(W, "rows"))
        principal = W.settings.robust_directions
        RegionDirections(codebook, torch.from_numpy(totals[0]), entries, principal).save(W.folder)
        level, scene = level_numbers(steps.compared_levels(W), codebook.regions), None
        shape = 2, codebook.regions + int(level.max(initial=0)) + 1
        for step in range(W.settings.robust_steps):
            self.run("robust", steps.compare, replace(W, step=step, by_region=whole is not None), W.solutions)
            scene = SceneAgreement.of(_sums(W, f"cosines-{step}", shape), whole, level)
            steps.write_agreement(W, step, scene)
        return W, scene.reliability if scene else None

    def discount_distance(self, W: Job) -> Job:
        self.run("loss", steps.measure, W, W.solutions)
        return replace(W, delta=mean_distance(_sums(W, "measure", (2, 1))))

    def solve(self, W: Job, clusters: RegionObjects | None) -> tuple[Tensor, SplatSupport]:
        job = _with_clusters(W, clusters)
        self.run("solve", steps.solve, job, job.solutions)
        sums, evidence = _column(job, "rows", "sums"), _column(job, "rows", "evidence")
        agreement, robust = _column(job, "columns", "agreement"), job.settings.robust_steps
        confidence = torch.from_numpy(_column(job, "columns", "confidence")) if robust else None
        support = SplatSupport(sums, torch.from_numpy(evidence), torch.from_numpy(agreement), confidence)
        return _mapped(job, job.solved_file), support

    def refine(self, W: Job, X: Tensor, seen: np.ndarray) -> NoReturn:
        """See the protocol: `LiftSettings.check_blocks` has refused what asks for it."""
        raise AssertionError("least squares need all rays in one place")

    def smooth(self, W: Job, X: Tensor, support: SplatSupport) -> NoReturn:
        """See the protocol: `LiftSettings.check_blocks` has refused what asks for it."""
        raise AssertionError("the graph of neighbours crosses blocks")

    def aggregate(self, W: Job, X: Tensor, clusters: RegionObjects | None) -> tuple[Tensor, Aggregation]:
        """See the protocol: the features of clusters that masks make."""
        assert clusters is not None, "check_blocks refuses those of features"
        job = _with_clusters(W, clusters)
        merged, taken, guarded = (
            torch.zeros(0, job.channels, dtype=job.dtype),
            torch.zeros(job.splats, dtype=torch.bool),
            None,
        )
        if job.clusters:
            merged = cluster_means(_sums(job, "columns", (job.channels + 1, job.clusters)), job.dtype)
            steps.write_piece(job.folder / steps.MERGED, {"merged": merged})
            self.run("aggregate", steps.spread, job, job.solutions)
            taken = torch.from_numpy(_column(job, "taken", "taken"))
            guarded = torch.from_numpy(_column(job, "taken", "guarded")) if job.guarded else None
            X = _mapped(job, job.features_file)
        clustering = Clustering(torch.from_numpy(clusters.labels), job.clusters, {"clustered_by": "graph"})
        facts = (MASKS_MADE if job.clusters else {}) | aggregation_facts(clustering, merged, taken, guarded)
        return X, Aggregation(clustering.labels, merged, facts, ~taken, (None,) * len(job.names))

    def measure(self, W: Job, X: Tensor) -> ViewMeasures:
        """See the protocol: a view at a time."""
        views = (read_view(W.view_file(number)) for number in range(len(W.names)))
        return joined([measure_view(view.sample, X, view.codebook.rows) for view in views])

    def deliver(self, W: Job, lift: LiftResult) -> LiftResult:
        """See the protocol: a lift in shards, mapped, whose files may lose their names."""
        columns = {name: part for name, part in vars(lift).items() if isinstance(part, Tensor) and name != "features"}
        write_index(W.folder / "lift", columns, W.solutions, lift.metadata.model_dump_json())
        return load_lift(W.folder / "lift")


def _with_clusters(job: Job, clusters: RegionObjects | None) -> Job:
    """The job whose splats may take the features of clusters."""
    if clusters is None:
        return job
    guarded = bool(job.settings.aggregation_guard and job.settings.robust_steps)
    return replace(job, clusters=clusters.count, guarded=guarded)


def _pieces(job: Job, step: str) -> Iterator[dict[str, np.ndarray]]:
    """What a step wrote of blocks of splats, one mapped at a time."""
    return (map_tensors(job.piece_file(step, number))[0] for number in range(job.solutions))


def _sums(job: Job, step: str, shape: tuple[int, int]) -> np.ndarray:
    """The sums that blocks of splats wrote, added up."""
    return added((part for arrays in _pieces(job, step) for part in unpacked(arrays)), shape)


def _column(job: Job, step: str, name: str) -> np.ndarray:
    """What a step wrote of all splats [P] under that name."""
    return np.concatenate([part[name] for part in _pieces(job, step)])


def _mapped(job: Job, file: Callable[[int], Path]) -> Tensor:
    """X [P, F] as it lies in the files of blocks."""
    return torch.from_numpy(map_rows([shard_at(file(number)) for number in range(job.solutions)]))


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
    together = {"offsets": np.cumsum(counts), "levels": np.concatenate(levels)}
    if together["offsets"][-1] > MOST_REGIONS:
        got, hint = f"{together['offsets'][-1]} in {len(job.names)} views", "lift fewer views, or smaller maps"
        raise Unavailable("features", expected=f"at most {MOST_REGIONS} regions", got=got, hint=hint)
    steps.write_piece(job.folder / steps.REGIONS, together)
    write_tensors(job.folder / steps.CODEBOOK, _Books(job), {})
    return WeightStatistics(plan, together["levels"], entries, tuple(blind))


class _Books(Mapping[str, Tensor]):
    """The codebooks of all views by names of their tensors, each read when it is asked for."""

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
    """Write what the tuples of all views are made of; how many splats belong to each region, [M] i64."""
    bases, parents, members, sizes = [0], list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for number in range(job.weighings):
        part = map_tensors(job.piece_file("relate", number))[0]
        own = part["parents"]
        parents.append(np.where(own < 0, own, own + np.int32(bases[-1])))
        members.append(part["members"].copy())
        sizes.append(part["sizes"].copy())
        bases.append(bases[-1] + own.size)
    together = {"bases": np.array(bases[:-1]), "parents": np.concatenate(parents), "members": np.concatenate(members)}
    steps.write_piece(job.folder / steps.TUPLES, together)
    return np.concatenate(sizes)
