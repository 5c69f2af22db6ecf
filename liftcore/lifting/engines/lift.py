"""The folder of a lift in blocks, for scenes whose W or X does not fit one machine: what workers need, and W of all.

An engine runs the steps.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.lifting.algebra import WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import Engine, LocalEngine
from liftcore.lifting.engines.blocks import (
    SCENE,
    Job,
    forget_files,
    gather,
    weigh,
    write_scene,
)
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.pieces import PIECE_VIEWS, ROWS, SELECTED, region_offsets
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.runtime.device import CPU, Device, choose_device
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.values.pack import NO_ROOM, Views, write_pack

PACKED = 64  # views of a pack
PIECES = re.compile("blocks-[0-9a-f]{64}")  # the folder of the pieces of one lift
PACKAGES = ("lifting", "raster", "scene", "solve", "values")  # whose code computes pieces


@contextmanager
def _folder(folder: Path | None, *, permanent: bool) -> Iterator[Path]:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    if folder is not None and permanent:
        yield folder.resolve()
        return
    with scratch_folder("splatlift-blocks-", folder) as scratch:
        yield scratch.resolve()


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


@dataclass(frozen=True)
class BlockFolder:
    """The folder of a lift in blocks, and its engine."""

    engine: Engine
    folder: Path  # that all workers share
    rows: int = ROWS  # splats of a block
    selected: int = SELECTED  # splats of scenes that workers load as a whole

    def plan(self, inputs: LiftInputs, device: Device, threads: int | None) -> Plan:
        """Plan the lift."""
        if inputs.settings.device == "auto" and not isinstance(self.engine, LocalEngine):
            device = CPU  # workers may have other GPUs than this machine, or none
        arguments = inputs.splats, inputs.views, inputs.settings, device, threads
        return plan_lift(*arguments, in_blocks=True, folder=self.folder, probe=bool(inputs.views.features.paths))

    def weigh(
        self, inputs: LiftInputs, plan: Plan, on_plan: Callable[[Plan], None], timings: Timings
    ) -> tuple[Job, WeightStatistics]:
        """Compute W of the plan's views, by views and by blocks of splats; call ``on_plan`` before."""
        on_plan(plan)
        with timings.step("share"):
            job = self._share(inputs, plan)
        for completed, _ in enumerate(self.engine.run(weigh, job, job.view_pieces), start=1):
            timings.progress("geometry", min(completed * PIECE_VIEWS, len(job.names)), len(job.names), "views")
        with timings.stage("gather"):
            statistics = _share_regions(job, plan)
            for completed, _ in enumerate(self.engine.run(gather, job, job.splat_pieces), start=1):
                timings.progress("gather", completed, job.splat_pieces, "blocks")
        return job, statistics

    def _share(self, inputs: LiftInputs, plan: Plan) -> Job:
        """Write the job's inputs for all workers, which all use the device of the plan."""
        splats, views, source = inputs.splats, inputs.views, inputs.source_views
        job = Job(
            settings=inputs.settings.model_copy(update={"device": plan.device.kind}), names=views.names,
            splats=splats.count, channels=views.features.channels, view_pieces=-(-len(views.names) // PIECE_VIEWS),
            rows=self.rows, folder=self.folder, packs=tuple(Path(path).resolve() for path in source.paths),
            cameras=views.cameras, kernel=splats.kernel, selected=self.selected,
        )  # fmt: skip
        job = replace(job, folder=_open_pieces(self.folder, _identity(job, splats)))
        if not (job.folder / SCENE).exists():
            write_scene(splats, job.folder / SCENE)
        if job.packs:
            return job
        return replace(job, packs=tuple(_packs(source, set(views.unpaired), job.folder)))


@contextmanager
def block_folder(
    engine: Engine, folder: Path | None = None, *, rows: int = ROWS, selected: int = SELECTED
) -> Iterator[BlockFolder]:
    """Open the folder of a lift by an engine, where each piece is a file.

    Args:
        folder: that all workers share. An interrupted lift of packs resumes from the pieces there; None: a temporary
            folder.
        rows, selected: as of `BlockFolder`.

    Raises:
        InvalidSettings: engine is of another type.
        Unavailable: the disk of the folder is full, or workers cannot read it.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    with _folder(folder or engine.scratch, permanent=folder is not None) as place, _in_words(place):
        try:
            yield BlockFolder(engine, place, rows, selected)
        finally:
            forget_files()


def _share_regions(job: Job, plan: Plan) -> WeightStatistics:
    """Write the numbers of the regions of all views."""
    pieces = [job.load("weights", piece) for piece in range(job.view_pieces)]
    levels, blind = (np.concatenate([piece[name] for piece in pieces]) for name in ("levels", "blind"))
    counts = np.concatenate([np.diff(piece["offsets"]) for piece in pieces])
    job.save("regions", None, {"offsets": region_offsets(counts), "levels": levels})
    blind_views = tuple(name for name, is_blind in zip(job.names, blind, strict=True) if is_blind)
    return WeightStatistics(plan, levels, sum(piece["region"].size for piece in pieces), blind_views)
