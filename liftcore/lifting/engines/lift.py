"""A lift in blocks, of scenes whose W, or X, is more than one machine should hold: what the driver does.

It has the steps done by an engine (`lifting.engines.steps`), adds up what they found of the scene, and shares it. It
holds tables of the size of M, a column or two of the splats, and the graph of objects; codebooks it hands on, a view
at a time.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.io.safetensors_file import map_tensors, write_tensors
from liftcore.io.shards import ROWS, map_rows, shard_at, write_index
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import steps
from liftcore.lifting.engines.base import Engine
from liftcore.lifting.engines.blocks import (
    SCENE,
    SELECTED,
    WEIGHED,
    Job,
    read_view,
    weigh,
    write_scene,
)
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.query.result import LiftResult, load_lift
from liftcore.runtime.device import choose_device
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, Timings
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.solve.aggregate import MASKS_MADE, aggregation_facts, cluster_means
from liftcore.solve.clusters import Clustering
from liftcore.solve.consensus import mean_share
from liftcore.solve.diagnostics import ViewMeasures, certify, joined, lift_warnings, measure_view
from liftcore.solve.directions import RegionDirections
from liftcore.solve.loss import mean_distance
from liftcore.solve.objects import (
    NodeViews,
    RegionObjects,
    choose_nodes,
    join,
    node_clusters,
    numbered,
    object_facts,
    object_numbers,
)
from liftcore.solve.reweight import SceneAgreement, agreement_facts, whole_regions
from liftcore.solve.sums import added, unpacked
from liftcore.values.lift_views import Given, LiftViews
from liftcore.values.pack import Views, as_views, write_pack
from liftcore.values.region_weights import MOST_REGIONS
from liftcore.values.settings import LiftSettings

if TYPE_CHECKING:
    from liftcore.lifting.engines.base import Work

PIECE = re.compile(
    r"(view|relate|rows|tuples|contain|labels-\d+|share|cosines-\d+|factors-\d+|measure|columns|solved|guard|taken"
    r"|features)-\d+\.safetensors"
)
PACKED = 64  # views of a pack
IDENTITY = "lift.json"  # of what the pieces in a folder are


def check_engine(engine: Engine, settings: LiftSettings, masks: bool) -> None:
    """Refuse, before the work, what is no engine, and what needs rays or features in one place.

    Args:
        masks: whether any view has masks, which make clusters in blocks.

    Raises:
        InvalidSettings: it is no engine; or as `LiftSettings.check_blocks` has it.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    settings.check_blocks(masks)


def lift_in_blocks(
    engine: Engine,
    splats: Splats,
    cameras: Cameras,
    views: Given,
    settings: LiftSettings,
    *,
    progress: Progress | None = None,
    on_plan: Callable[[Plan], None],
    folder: Path | None = None,
    rows: int = ROWS,
    selected: int = SELECTED,
) -> LiftResult:
    """`liftcore.lift` by an engine: each piece is a file in a folder, and X lies in shards that are mapped.

    Args:
        folder: that all workers share. A lift that was cut off goes on from the pieces there; None: one that is gone
            at the end.
        rows: splats that are solved together, whole pages of X. selected: splats of scenes that workers hold whole.

    Raises:
        InvalidSettings: the settings need W or X in one place.
    """
    timings = Timings(progress)
    given = as_views(views)
    found = LiftViews.of(given, cameras, settings)
    check_engine(engine, settings, any(found.features.is_regions(name) for name in found.names))
    with timings.step("plan"):
        plan = plan_lift(splats, found, settings, choose_device(settings.device), apart=True, look=bool(given.paths))
        found.names = list(plan.views)
    on_plan(replace(plan, memory=_memory_of_a_worker(plan), weight_bytes=0))
    with _folder(folder or engine.scratch, kept=folder is not None) as place:
        with timings.step("share"):
            packs = given.paths or _packs(given, found, place)
            job = Job(
                place,
                tuple(Path(path).resolve() for path in packs),
                found.cameras,
                tuple(found.names),
                settings,
                splats.kernel,
                splats.count,
                found.features.channels,
                rows=rows,
                selected=selected,
            )
            _begin(job, splats, given)
        with timings.stage("geometry"):
            for done, _ in enumerate(engine.run(weigh, job, job.weighings), start=1):
                timings.progress("geometry", min(done * WEIGHED, len(job.names)), len(job.names), "views")
        work = _Steps(engine, job, timings)
        columns, notes = work.solve()
        with timings.step("certify"):
            sums, table = columns.pop("sums").numpy(), found.features.table
            certificate = _certificate(work.job, splats, found, plan, sums, columns["evidence"], notes)
        metadata = found.metadata(settings, splats.origin, certificate, timings.seconds)
        if table:
            columns["embeddings"] = torch.from_numpy(table.embeddings)
        write_index(place / "lift", columns, job.solutions, metadata.model_dump_json())
        return load_lift(place / "lift")  # mapped: the files may lose their names


def _memory_of_a_worker(plan: Plan) -> dict[str, int]:
    """Bytes of each part of a worker at its peak, about, from those of a lift in one place."""
    splats = min(1.0, ROWS / plan.splats)
    held = min(1.0, max(SELECTED, plan.splats_a_view) / plan.splats)
    shares = {"splats": held, "scene": held, "weights": min(1.0, WEIGHED / len(plan.views))}
    shares |= {"gathered": splats, "features": splats}
    return {name: int(size * shares.get(name, 1.0)) for name, size in plan.memory.items()}


@contextmanager
def _folder(folder: Path | None, *, kept: bool) -> Iterator[Path]:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    if folder is not None and kept:
        yield folder.resolve()
        return
    with tempfile.TemporaryDirectory(dir=folder, prefix="splatlift-blocks-") as own:
        yield Path(own).resolve()


def _packs(given: Views, found: LiftViews, folder: Path) -> list[Path]:
    """Views that lie in no pack, written into some: whoever works on a view reads it there."""
    names = [name for name in given if name in found.features or name in found.names]
    packs = []
    for number, begin in enumerate(range(0, len(names), PACKED)):
        packs.append(folder / f"views-{number:05}.safetensors")
        some = names[begin : begin + PACKED]
        told = {"encoder": given.encoder, "text_space": given.text_space}
        write_pack(packs[-1], _Some(given, some), told)
    return packs


class _Some(dict[str, Any]):
    """Some views of many, each read when it is asked for."""

    def __init__(self, views: Views, names: list[str]) -> None:
        super().__init__(dict.fromkeys(names))
        self._views = views

    def __getitem__(self, name: str) -> Any:
        return self._views[name]

    def items(self) -> Any:
        return ((name, self._views[name]) for name in self)


def _begin(job: Job, splats: Splats, given: Views) -> None:
    """Write the scene, and leave of earlier pieces those of this same lift."""
    facts = choose_device(job.settings.device).facts()
    told = [Checkpoint(job.folder).of(splats, facts).identity, job.settings.model_dump_json(), job.names, job.rows]
    told += [job.kernel]
    told += [[_facts(camera) for camera in job.cameras.values()]]
    told += [[(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in job.packs] if given.paths else []]
    identity = hashlib.sha256(json.dumps(told).encode()).hexdigest()
    kept = job.folder / IDENTITY
    if not kept.is_file() or kept.read_text() != identity or not given.paths:
        for path in (*job.folder.glob("*.safetensors"), *(job.folder / "lift").glob("features-*.safetensors")):
            if PIECE.fullmatch(path.name):
                path.unlink()
        write_scene(splats, job.folder / SCENE)
        kept.write_text(identity)


def _facts(camera: Camera) -> list[Any]:
    size = camera.width, camera.height
    return [camera.name, *size, camera.K.tolist(), camera.viewmat.tolist(), repr(camera.lens or camera.face)]


class _Steps:
    """The steps after the views are weighed, as `liftcore.lift` takes them, by an engine."""

    def __init__(self, engine: Engine, job: Job, timings: Timings) -> None:
        self.engine, self.timings = engine, timings
        self.levels, self.entries = _share_regions(job)
        masks, settings = bool((self.levels >= 0).any()), job.settings
        self.find_objects, self.ask_consensus = settings.finds_objects(masks), settings.asks_consensus(masks)
        codebook = steps.codebook_of(job)
        dtype = getattr(torch, settings.dtype)
        dtype = torch.float32 if dtype == torch.float16 and not codebook.fits_float16() else dtype
        self.job = replace(job, dtype=dtype, related=self.find_objects or self.ask_consensus)

    def run(self, stage: str, work: Work, pieces: int) -> None:
        """Have a step done for all pieces."""
        for done, _ in enumerate(self.engine.run(work, self.job, pieces), start=1):
            self.timings.progress(stage, done, pieces, "blocks")

    def pieces(self, step: str, pieces: int) -> Iterator[dict[str, np.ndarray]]:
        """What a step wrote, one piece mapped at a time."""
        return (map_tensors(self.job.piece_file(step, number))[0] for number in range(pieces))

    def sums(self, files: Iterable[dict[str, np.ndarray]], shape: tuple[int, int]) -> np.ndarray:
        """The sums that blocks of splats wrote, added up."""
        return added((part for arrays in files for part in unpacked(arrays)), shape)

    @one_thread()
    def solve(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Columns of the lift [P], without X, and what its diagnostics say of the steps."""
        timings, settings, notes = self.timings, self.job.settings, dict[str, Any]()
        with timings.stage("gather"):
            self._gather()
        found = None
        if self.find_objects:
            with timings.stage("objects"):
                found = self._objects()
        if self.ask_consensus:
            with timings.stage("consensus"):
                self.run("consensus", steps.share, self.job.weighings)
                parts = [part["told"] for part in self.pieces("share", self.job.weighings)]
                told, asked = np.sum(parts, axis=0)
                self.job = replace(self.job, usual_share=mean_share(int(told), int(asked)))
        reliability = None
        if settings.robust_steps:
            with timings.stage("robust"):
                reliability = self._reweigh()
        if settings.loss == "huber":
            with timings.stage("loss"):
                self.run("loss", steps.measure, self.job.solutions)
                sums = self.sums(self.pieces("measure", self.job.solutions), (2, 1))
                self.job = replace(self.job, delta=mean_distance(sums))
        if settings.aggregation and found:
            guarded = bool(settings.aggregation_guard and settings.robust_steps)
            self.job = replace(self.job, clusters=len(found.views), guarded=guarded)
        with timings.stage("solve"):
            self.run("solve", steps.solve, self.job.solutions)
        columns = self._columns("columns")
        if settings.aggregation and found:
            with timings.stage("aggregate"):
                notes["aggregation"] = self._aggregate(found, columns)
        if settings.robust_steps:
            notes["reweighting"] = agreement_facts(self.levels, reliability, columns["confidence"])
        if found and settings.objects:
            notes["objects"] = object_facts(found)
            columns |= {"object": torch.from_numpy(found.labels), "object_views": torch.from_numpy(found.views)}
        return columns, notes

    def _gather(self) -> None:
        """W by blocks of splats, and what places of the curve mean."""
        job = self.job
        if job.related:
            self.run("gather", steps.relate, job.weighings)
            sizes, groups = _share_tuples(job), steps.groups_of(job)
            if self.find_objects:
                nodes, others = choose_nodes(groups, sizes)
                steps.write_piece(job.folder / steps.NODES, {"nodes": nodes, "others": others})
        self.run("gather", steps.gather, job.solutions)
        bounds = np.concatenate([part["bounds"] for part in self.pieces("rows", job.solutions)])
        if bounds.size:
            bounds = np.stack([bounds.min(axis=0), bounds.max(axis=0)])
        steps.write_piece(job.folder / steps.CURVE, {"bounds": bounds})

    def _objects(self) -> RegionObjects:
        """The objects of the scene."""
        job, groups = self.job, steps.groups_of(self.job)
        nodes, others = (map_tensors(job.folder / steps.NODES)[0][name] for name in ("nodes", "others"))
        self.run("objects", steps.contain, job.weighings)
        parts = list(self.pieces("contain", job.weighings))
        together = NodeViews(*(np.concatenate([part[name] for part in parts]) for name in ("container", "sees")))
        clusters = node_clusters(nodes, groups, together)
        number = int(clusters.max(initial=-1)) + 1
        if number and others.size:
            self._label(0, clusters=clusters)
            shares = (part for file in self.pieces("labels-0", job.solutions) for part in unpacked(file))
            join(clusters, others, shares, number)
        self._label(1, clusters=clusters)
        labels, evidence = (
            np.concatenate([part[name] for part in self.pieces(step, job.solutions)])
            for step, name in (("labels-1", "labels"), ("rows", "evidence"))
        )
        shown = self.sums(self.pieces("labels-1", job.solutions), (1, number * groups.views))
        place = object_numbers(labels, evidence, number)
        steps.write_piece(job.folder / steps.CLUSTERS, {"place": place})
        return numbered(labels, clusters, place, shown.reshape(number, groups.views))

    def _label(self, step: int, **shared: np.ndarray) -> None:
        steps.write_piece(self.job.folder / steps.CLUSTERS, shared)
        self.job = replace(self.job, step=step)
        self.run("objects", steps.label, self.job.solutions)

    def _reweigh(self) -> float | None:
        """The robust steps but for the last one's factors, which blocks take when they are solved."""
        codebook, whole = steps.codebook_of(self.job), whole_regions(self.job.settings.reliability, self.levels)
        totals = self.sums(self.pieces("rows", self.job.solutions), (1, codebook.regions))
        RegionDirections(codebook, torch.from_numpy(totals[0]), self.entries).save(self.job.folder)
        scene = None
        for step in range(self.job.settings.robust_steps):
            self.job = replace(self.job, step=step, by_region=whole is not None)
            self.run("robust", steps.compare, self.job.solutions)
            shape = 2, codebook.regions + 1
            sums = self.sums(self.pieces(f"cosines-{step}", self.job.solutions), shape)
            scene = SceneAgreement.of(sums, whole)
            steps.write_agreement(self.job, step, scene)
        return scene.reliability if scene else None

    def _aggregate(self, found: RegionObjects, columns: dict[str, Tensor]) -> dict[str, Any]:
        """The features of clusters, which splats take; columns of both, and what the diagnostics say of them."""
        job, clusters = self.job, self.job.clusters
        clustering = Clustering(torch.from_numpy(found.labels), clusters, {"clustered_by": "graph"})
        merged, taken, guarded = torch.zeros(0, job.channels, dtype=job.dtype), torch.zeros(job.splats) > 0, None
        if clusters:
            merged = cluster_means(
                self.sums(self.pieces("columns", job.solutions), (job.channels + 1, clusters)), job.dtype
            )
            place = map_tensors(job.folder / steps.CLUSTERS)[0]["place"]
            steps.write_piece(job.folder / steps.CLUSTERS, {"place": place, "merged": merged})
            self.run("aggregate", steps.spread, job.solutions)
            parts = self._columns("taken")
            taken, guarded = parts["taken"], parts.get("guarded")
        columns |= {"cluster": clustering.labels, "cluster_features": merged}
        return (MASKS_MADE if clusters else {}) | aggregation_facts(clustering, merged, taken, guarded)

    def _columns(self, step: str) -> dict[str, Tensor]:
        """What else is known of all splats [P]."""
        parts = [
            {name: array.copy() for name, array in part.items() if not name.startswith("sums/")}
            for part in self.pieces(step, self.job.solutions)
        ]
        return {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in parts[0]}


def _share_regions(job: Job) -> tuple[np.ndarray, int]:
    """Write the numbers of regions and the codebook of all views; the level of each region, and the entries of W."""
    counts, levels, entries = [0], list[np.ndarray](), 0
    for number in range(len(job.names)):
        found = read_view(job.view_file(number))
        counts.append(found.codebook.regions)
        levels.append(found.levels.copy())
        entries += found.weights.region.shape[0]
    together = {"offsets": np.cumsum(counts), "levels": np.concatenate(levels)}
    if together["offsets"][-1] > MOST_REGIONS:
        got, hint = f"{together['offsets'][-1]} in {len(job.names)} views", "lift fewer views, or smaller maps"
        raise Unavailable("features", expected=f"at most {MOST_REGIONS} regions", got=got, hint=hint)
    steps.write_piece(job.folder / steps.REGIONS, together)
    write_tensors(job.folder / steps.CODEBOOK, _Books(job), {})
    return together["levels"], entries


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


@one_thread()
def _certificate(
    job: Job,
    splats: Splats,
    views: LiftViews,
    plan: Plan,
    sums: np.ndarray,
    evidence: Tensor,
    notes: dict[str, Any],
) -> dict[str, Any]:
    """What the lift measured of itself: a view at a time, on X as it lies in its shards."""
    shards = [shard_at(job.features_file(number)) for number in range(job.solutions)]
    X = torch.from_numpy(map_rows(shards))
    measures, entries, blind = list[ViewMeasures](), 0, []
    for number, name in enumerate(job.names):
        found = read_view(job.view_file(number))
        measures.append(measure_view(found.sample, X, found.codebook.rows))
        entries += found.weights.region.shape[0]
        if not found.weights.evidence.numel():
            blind.append(name)
    facts: dict[str, Any] = {
        "device": choose_device(job.settings.device).facts(),
        "weights_entries": entries,
        "views_without_camera": views.unpaired,
        "plan": plan.facts(),
        "views_without_splats": blind,
    }
    lifted = [views.camera(number) for number in range(len(views))]
    told = lift_warnings(splats, lifted, sums, job.settings.dtype, X.dtype, facts)
    facts["warnings"] = [*told, *plan.told]
    return certify(joined(measures), sums, evidence, job.settings) | notes | facts
