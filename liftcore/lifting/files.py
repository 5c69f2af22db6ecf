"""A lift of files: they are read, lifted as values, and remembered with their digests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from liftcore.errors import InvalidFeatures
from liftcore.io.cameras import read_cameras
from liftcore.io.remote import local_path
from liftcore.io.splats import read_splats
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines.base import Engine
from liftcore.lifting.pipeline import lift
from liftcore.lifting.planning.plan import Plan
from liftcore.query.result import LiftResult
from liftcore.runtime.device import choose_device
from liftcore.runtime.progress import Progress, Timings
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Splats
from liftcore.values.lift_file import input_files
from liftcore.values.pack import Views, read_features
from liftcore.values.settings import LiftSettings


def lift_files(
    splats: Path | str,
    cameras: Path | str,
    features: Sequence[Path | str],
    settings: LiftSettings,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    checkpoint: Checkpoint | None = None,
    engine: Engine | None = None,
) -> LiftResult:
    """Lift the features of packs onto the splats of a file, as `liftcore.lift` does.

    Args:
        splats: a PLY of any dialect. cameras: COLMAP, transforms.json or cameras.json. features: feature packs.

    Raises:
        InvalidInput: a file is malformed, or the packs do not fit the cameras.
        Unavailable: there is no such device as asked for.
    """
    choose_device(settings.device)  # told before gigabytes are read
    paths = local_path(splats), local_path(cameras), _checked(features)
    timings = Timings(progress)
    with timings.step("read"):
        sources = open_files(*paths, settings)
    with timings.step("digest"):
        inputs = input_files(*paths, views=sources[2].views)
    given = {
        "threads": threads,
        "progress": timings.progress,
        "on_plan": on_plan,
        "checkpoint": checkpoint,
        "engine": engine,
    }
    made = lift(*sources, settings, **given)
    own = {"splats": inputs[0], "cameras": inputs[1], "features": tuple(inputs[2:])}
    own["timings"] = timings.seconds | made.metadata.timings
    return replace(made, metadata=made.metadata.model_copy(update=own))


def open_files(
    splats: Path, cameras: Path, features: Sequence[Path | str], settings: LiftSettings
) -> tuple[Splats, Cameras, Views]:
    """What a lift with these settings takes: splats, cameras, and packs whose headers are read.

    The splats come without their colours; with ``smoothness`` they have those of degree 0.

    Raises:
        InvalidInput: a file is malformed.
    """
    scene = read_splats(splats, settings.kernel, colour=bool(settings.smoothness))
    if scene.sh is not None:
        base = {"sh": scene.sh[:, :1].clone(), "sb_params": None, "extras": {}, "layout": (), "header": ()}
        scene = replace(scene, **base)
    settings.for_splats(scene)  # refuses what does not suit them before gigabytes are read
    packs = read_features(*_checked(features))
    return scene, read_cameras(cameras, views=packs.views), packs


def _checked(features: Sequence[Path | str]) -> list[Path]:
    if isinstance(features, str | Path):  # a text is a sequence too, of letters
        raise InvalidFeatures("features", expected="a list of feature packs", got=f"{str(features)!r} alone")
    return [local_path(pack) for pack in features]
