"""The folder of a lift in blocks, for scenes whose W or X does not fit one machine: its inputs for workers, and W.

An engine runs the steps.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.lifting.algebra import WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import Engine
from liftcore.lifting.engines.blocks import SCENE, PiecesInFiles, forget_files, gather, weigh, write_scene
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.pieces import PIECE_VIEWS, ROWS, SELECTED, region_offsets
from liftcore.lifting.planning.plan import Plan
from liftcore.runtime.device import choose_device
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.values.pack import Views, write_pack

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
PACKED = 64  # views of a pack
PIECES = re.compile("blocks-[0-9a-f]{64}")  # the folder of the pieces of one lift
PACKAGES = ("lifting", "raster", "scene", "solve", "values")  # whose code computes pieces


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


def _identity(pieces: PiecesInFiles, splats: Splats) -> str:
    """Return the digest, in hex, of all that pieces depend on; it is unique if views are in no pack."""
    facts = choose_device(pieces.settings.device).facts()
    depends = [Checkpoint(pieces.folder).of(splats, facts, PACKAGES).identity, pieces.settings.model_dump_json()]
    depends += [pieces.names, pieces.rows, pieces.kernel, [_facts(camera) for camera in pieces.cameras.values()]]
    packs = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in pieces.packs]
    return hashlib.sha256(json.dumps([*depends, packs or secrets.token_hex()]).encode()).hexdigest()


def _open_pieces(folder: Path, identity: str) -> Path:
    """Open the folder of a lift's pieces; delete those of other lifts, and unfinished files of workers that died.

    Each lift has a folder of its own, so that a worker of a killed lift cannot write into another lift's files.
    """
    lift_folder = folder / f"blocks-{identity}"
    for other in folder.glob("blocks-*"):
        if other != lift_folder and PIECES.fullmatch(other.name):
            shutil.rmtree(other, ignore_errors=True)
    lift_folder.mkdir(exist_ok=True)
    for draft in lift_folder.rglob(".*.part"):
        draft.unlink(missing_ok=True)
    return lift_folder


def _facts(camera: Camera) -> list[Any]:
    size = camera.width, camera.height
    return [camera.name, *size, camera.K.tolist(), camera.viewmat.tolist(), repr(camera.lens)]


@contextmanager
def engine_folder(engine: Engine, checkpoint: Checkpoint | None) -> Iterator[Path]:
    """Open the folder of a lift by an engine, where each piece is a file.

    Args:
        checkpoint: its folder, which all workers share: a lift of packs resumes from the pieces there; None: a
            temporary folder.

    Raises:
        InvalidSettings: engine is of another type.
        Unavailable: the disk of the folder is full, or workers cannot read it.
    """
    if not hasattr(engine, "run"):
        hint = "LocalEngine() or RayEngine(address) makes one"
        raise InvalidSettings("engine", expected="an engine, or None", got=repr(engine)[:80], hint=hint)
    folder = checkpoint.folder if checkpoint else engine.scratch
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        if folder is None or not checkpoint:
            folder = stack.enter_context(scratch_folder("splatlift-blocks-", folder))
        folder = folder.resolve()
        stack.enter_context(_in_words(folder))
        stack.callback(forget_files)
        yield folder


def weigh_in_files(
    engine: Engine, folder: Path, inputs: LiftInputs, plan: Plan, timings: Timings
) -> tuple[PiecesInFiles, WeightStatistics]:
    """Compute W of the plan's views, by views and by blocks of splats."""
    with timings.step("share"):
        pieces = _share(inputs, plan, folder)
    for completed, _ in enumerate(engine.run(weigh, pieces, pieces.view_pieces), start=1):
        timings.progress("geometry", min(completed * PIECE_VIEWS, len(pieces.names)), len(pieces.names), "views")
    with timings.stage("gather"):
        statistics = _share_regions(pieces, plan)
        for completed, _ in enumerate(engine.run(gather, pieces, pieces.splat_pieces), start=1):
            timings.progress("gather", completed, pieces.splat_pieces, "blocks")
    return pieces, statistics


def _share(inputs: LiftInputs, plan: Plan, folder: Path) -> PiecesInFiles:
    """Write the inputs of the pieces for all workers, which all use the device of the plan."""
    splats, views, source = inputs.splats, inputs.views, inputs.source_views
    pieces = PiecesInFiles(
        settings=inputs.settings.model_copy(update={"device": plan.device.kind}), names=views.names,
        splats=splats.count, channels=views.features.channels, view_pieces=-(-len(views.names) // PIECE_VIEWS),
        rows=ROWS, folder=folder, packs=tuple(Path(path).resolve() for path in source.paths),
        cameras=views.cameras, kernel=splats.kernel, selected=SELECTED,
    )  # fmt: skip
    pieces = replace(pieces, folder=_open_pieces(folder, _identity(pieces, splats)))
    if not (pieces.folder / SCENE).exists():
        write_scene(splats, pieces.folder / SCENE)
    if pieces.packs:
        return pieces
    return replace(pieces, packs=tuple(_packs(source, set(views.unpaired), pieces.folder)))


def _share_regions(pieces: PiecesInFiles, plan: Plan) -> WeightStatistics:
    """Write the numbers of the regions of all views."""
    weights = [pieces.load("weights", piece) for piece in range(pieces.view_pieces)]
    levels, blind = (np.concatenate([part[name] for part in weights]) for name in ("levels", "blind"))
    counts = np.concatenate([np.diff(part["offsets"]) for part in weights])
    pieces.save("regions", None, {"offsets": region_offsets(counts), "levels": levels})
    blind_views = tuple(name for name, is_blind in zip(pieces.names, blind, strict=True) if is_blind)
    return WeightStatistics(plan, levels, sum(part["region"].size for part in weights), blind_views)
