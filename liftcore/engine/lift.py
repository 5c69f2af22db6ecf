"""A lift in blocks: the closed form of scenes whose W, or X, is more than one machine should hold."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore import __version__
from liftcore.device import choose_device
from liftcore.engine.base import Engine
from liftcore.engine.blocks import SCENE, SELECTED, SUMMED, WEIGHED, Job, read_view, solve, weigh, write_scene
from liftcore.errors import InvalidSettings
from liftcore.features.pack import Views, as_views, write_pack
from liftcore.io.lift_file import load_lift, poses_of
from liftcore.io.safetensors_file import map_tensors
from liftcore.io.shards import ROWS, map_rows, shard_at, write_index
from liftcore.one_thread import one_thread
from liftcore.planning.plan import Plan, plan_lift
from liftcore.progress import Progress, Timings
from liftcore.result import LiftMetadata, LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings
from liftcore.solve.checkpoint import Checkpoint
from liftcore.solve.codebook import float16_holds, row_lengths
from liftcore.solve.diagnostics import ViewMeasures, certify, joined, lift_warnings, measure_view
from liftcore.solve.geometry import Given, LiftViews

IDENTITY = "lift.json"  # of what the pieces in a folder are


def needs_all(settings: LiftSettings) -> list[str]:
    """The settings that need all regions or all splats in one place, as they are set."""
    names = ("robust_steps", "loss", "objects", "aggregation", "cg_steps", "reference_channels")
    return [f"{name}={value}" for name in names if (value := getattr(settings, name)) not in (0, "auto", "l2")]


def check_engine(engine: Engine, settings: LiftSettings) -> None:
    """Refuse, before the work, what needs W or X in one place.

    Raises:
        InvalidSettings: it is no engine; reweighting, Huber's loss, objects, aggregation, or least squares.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    asked = needs_all(settings)
    if asked:
        raise InvalidSettings(
            "engine",
            expected="settings of the closed form alone: reweighting, Huber's loss, objects, aggregation and least "
            "squares need all regions or splats in one place",
            got=", ".join(asked),
            hint="take a preset without them (row-sum, tikhonov), or lift without an engine",
        )


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
    check_engine(engine, settings)
    timings = Timings(progress)
    given = as_views(views)
    found = LiftViews.of(given, cameras, settings)
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
        job = replace(job, dtype=_dtype(job))
        with timings.stage("solve"):
            for done, _ in enumerate(engine.run(solve, job, job.solutions), start=1):
                timings.progress("solve", done, job.solutions, "blocks")
        with timings.step("certify"):
            columns, table = _columns(job), found.features.table
            sums = columns.pop("sums").numpy()
            certificate = _certificate(job, splats, found, plan, sums, columns["evidence"])
        metadata = LiftMetadata(
            version=__version__,
            settings=settings,
            encoder=found.features.encoder,
            text_space=found.features.text_space,
            words=table.words if table else (),
            views=job.names,
            poses=poses_of([found.camera(number) for number in range(len(found))]),
            certificate=certificate,
            timings=timings.seconds,
        )
        if table:
            columns["embeddings"] = torch.from_numpy(table.embeddings)
        write_index(place / "lift", columns, job.solutions, metadata.model_dump_json())
        return load_lift(place / "lift")  # mapped: the files may lose their names


def _memory_of_a_worker(plan: Plan) -> dict[str, int]:
    """Bytes of each part of a worker at its peak, about, from those of a lift in one place."""
    views, splats = min(1.0, SUMMED / len(plan.views)), min(1.0, ROWS / plan.splats)
    held = min(1.0, max(SELECTED, plan.splats_a_view) / plan.splats)
    shares = {"splats": held, "scene": held, "weights": min(1.0, WEIGHED / len(plan.views))}
    shares |= {"gathered": views * splats, "codebooks": views, "features": splats}
    parts = {name: int(size * shares.get(name, 1.0)) for name, size in plan.memory.items()}
    return parts | {"sums": 8 * int(plan.splats * splats) * plan.channels}  # X of the group, and of all before it


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
    for number, begin in enumerate(range(0, len(names), SUMMED)):
        packs.append(folder / f"views-{number:05}.safetensors")
        some = names[begin : begin + SUMMED]
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
        for pattern in ("view-*.safetensors", "columns-*.safetensors", "lift/features-*.safetensors"):
            for path in job.folder.glob(pattern):
                path.unlink()
        write_scene(splats, job.folder / SCENE)
        kept.write_text(identity)


def _facts(camera: Camera) -> list[Any]:
    size = camera.width, camera.height
    return [camera.name, *size, camera.K.tolist(), camera.viewmat.tolist(), repr(camera.lens or camera.face)]


def _dtype(job: Job) -> torch.dtype:
    """The type of X: the settings', if it holds what the codebooks hold."""
    asked = getattr(torch, job.settings.dtype)
    if asked != torch.float16:
        return asked
    books = (read_view(job.view_file(number)).codebook.rows for number in range(len(job.names)))
    return torch.float16 if float16_holds((rows, row_lengths(rows)) for rows in books) else torch.float32


def _columns(job: Job) -> dict[str, Tensor]:
    """What else is known of all splats [P]."""
    parts = list[dict[str, np.ndarray]]()
    for number in range(job.solutions):
        mapped, _ = map_tensors(job.columns_file(number))
        parts.append({name: array.copy() for name, array in mapped.items()})  # a mapping holds its file open
    return {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in parts[0]}


@one_thread()
def _certificate(
    job: Job, splats: Splats, views: LiftViews, plan: Plan, sums: np.ndarray, evidence: Tensor
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
    return certify(joined(measures), sums, evidence, job.settings) | facts
