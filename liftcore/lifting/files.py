"""Lifts of files: read them, lift their values, and store their paths and digests in the lift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from liftcore.errors import InvalidFeatures
from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from liftcore.lifting.engines import Engine
from liftcore.lifting.pipeline import lift, plan
from liftcore.lifting.planning.plan import Plan
from liftcore.query.result import LiftResult
from liftcore.runtime.arguments import as_path
from liftcore.runtime.device import choose_device
from liftcore.runtime.progress import Progress, Timings, shown_progress
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Splats
from liftcore.values.lift_file import input_files
from liftcore.values.pack import Views, read_features
from liftcore.values.settings import LiftSettings


def lift_files(
    splats: Path | str,
    cameras: Path | str,
    features: Sequence[Path | str],
    settings: LiftSettings | None = None,
    *,
    threads: int | None = None,
    progress: Progress | bool | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    checkpoint: Path | str | None = None,
    engine: Engine | None = None,
) -> LiftResult:
    """Lift the features of packs onto the splats of a file, as `liftcore.lift` does, and store the files' digests.

    Args:
        splats: of any format that `read_splats` reads. cameras: likewise of `read_cameras`. features: feature packs.
        settings: None: the defaults. The other arguments are those of `liftcore.lift`.

    Raises:
        InvalidInput: a file is malformed, or the packs do not fit the cameras.
        InvalidSettings: settings are of another type.
        Unavailable: the device does not exist.
    """
    settings = LiftSettings.or_default(settings)
    choose_device(settings.device)  # raises before gigabytes are read
    paths = as_path(splats), as_path(cameras), _pack_paths(features)
    with shown_progress(progress) as reporter:
        timings = Timings(reporter)
        with timings.step("read"):
            sources = open_files(*paths, settings)
        with timings.step("digest"):
            inputs = input_files(*paths)
        keywords = {"threads": threads, "on_plan": on_plan, "checkpoint": checkpoint, "engine": engine}
        result = lift(*sources, settings, progress=reporter, **keywords)
    facts = {"splats": inputs[0], "cameras": inputs[1], "features": tuple(inputs[2:])}
    facts["timings"] = timings.seconds | result.metadata.timings
    return replace(result, metadata=result.metadata.model_copy(update=facts))


def plan_files(
    splats: Path | str,
    cameras: Path | str,
    features: Sequence[Path | str],
    settings: LiftSettings | None = None,
    *,
    threads: int | None = None,
    in_blocks: bool = False,
) -> Plan:
    """Plan the lift of `lift_files` with the same arguments, as `liftcore.plan` does."""
    settings = LiftSettings.or_default(settings)
    sources = open_files(as_path(splats), as_path(cameras), features, settings)
    return plan(*sources, settings, threads=threads, in_blocks=in_blocks)


def open_files(
    splats: Path, cameras: Path, features: Sequence[Path | str], settings: LiftSettings
) -> tuple[Splats, Cameras, Views]:
    """Open the inputs of a lift with these settings: splats, cameras, and packs, of which headers alone are read.

    The splats have no colours; with ``smoothness`` they have those of degree 0.

    Raises:
        InvalidInput: a file is malformed.
    """
    scene = read_splats(splats, settings.kernel, colour=bool(settings.smoothness))
    if scene.sh is not None:
        base = {"sh": scene.sh[:, :1].clone(), "sb_params": None, "extras": {}, "layout": (), "header": ()}
        scene = replace(scene, **base)
    settings.for_splats(scene)  # raises if they do not suit the splats, before gigabytes are read
    packs = read_features(*_pack_paths(features))
    return scene, read_cameras(cameras), packs


def _pack_paths(features: Sequence[Path | str]) -> list[Path]:
    if isinstance(features, str | Path):  # a str is a sequence too
        raise InvalidFeatures("features", expected="a list of feature packs", got=f"{str(features)!r} alone")
    return [as_path(pack) for pack in features]
