"""Functions that run in child processes: checks, renamed packs and plans while a request waits (`service.sandbox`),
and the work of jobs (`service.job_child`)."""

from __future__ import annotations

import json
import logging
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore import (
    Checkpoint,
    Kernel,
    LiftResult,
    LiftSettings,
    Plan,
    lift_files,
    load_lift,
    open_engine,
    plan_files,
    read_features,
)
from liftcore.errors import InvalidFeatures, InvalidInput, InvalidLift, SplatliftError
from liftcore.evaluate import inspect_file
from liftcore.files import finite, identify, with_metadata, wrong_kind
from liftcore.text.table import TableEncoder
from service import models
from service.child import fault_of, replace_names
from service.models import AssetKind, UploadKind
from service.store.files import sha256_of
from service.store.lifts import LONG, SHOWN_BYTES
from service.uploads import INVALID, LIFT

if TYPE_CHECKING:
    from service.job_child import Reporter

BLOCK_ROWS = 1 << 14  # of a lift, checked at a time
SHOWN_DIGITS = 12  # of the splats' digest, in the title of a trade-off's chart

log = logging.getLogger(__name__)


def _describe(path: Path, kind: AssetKind) -> dict[str, Any]:
    """Describe the content of a file of that kind, read whole; files that can run code are refused."""
    description = inspect_file(path, kind, trusted=False)
    return {name: value for name, value in description.items() if name not in ("kind", "bytes")}


def check_splats(path: Path) -> dict[str, Any]:
    """Read and describe every splat; checkpoints are pickles and are not opened here."""
    return {"found": _describe(path, AssetKind.SPLATS), "suffix": identify(path).suffix}


def check_cameras(path: Path) -> dict[str, Any]:
    """Read and describe every camera."""
    description = _describe(path, AssetKind.CAMERAS)
    return {"suffix": ".zip" if zipfile.is_zipfile(path) else ".json", "found": description}


def require_texts(argument: str, texts: Sequence[str], longest: int, error: type[InvalidInput]) -> None:
    """Require names or words of a length that a query can have, and lists of a limited length."""
    for text in texts:
        if len(text) > longest or not (text or argument == "word"):  # a table may have a row without a word
            raise error(
                argument, expected=f"1 to {longest} characters",
                got=f"{len(text)}: {text[:40]!r}..." if text else "an empty one",
                hint="name each image, without folders where that is enough" if argument == "view name" else "",
            )  # fmt: skip
    if (total := sum(map(len, texts))) > models.FILE_CHARACTERS:
        limit = f"at most {models.FILE_CHARACTERS} characters of all together"
        raise error(argument, expected=limit, got=f"{total} in {len(texts)}", hint="several files hold more")


def check_features(path: Path) -> dict[str, Any]:
    """Read and describe every observation."""
    packs = read_features(path)
    require_texts("word", packs.table.words if packs.table else (), models.WORD_CHARACTERS, InvalidFeatures)
    for name in ("encoder", "text_space"):
        if len(text := getattr(packs, name)) > models.WORD_CHARACTERS:
            expected = f"at most {models.WORD_CHARACTERS} characters"
            raise InvalidFeatures(name, expected=expected, got=f"{len(text)}: {text[:40]!r}...")
    return {"suffix": ".safetensors", "found": _describe(path, AssetKind.FEATURES)}


def check_masks(path: Path) -> dict[str, Any]:
    """Read and describe every mask."""
    return {"suffix": ".safetensors", "found": _describe(path, AssetKind.MASKS)}


def check_table(path: Path) -> dict[str, Any]:
    """Read every row, and keep all words: orders are checked against them."""
    words = list(TableEncoder.open(path).words)
    return {"suffix": ".safetensors", "found": _describe(path, AssetKind.TABLE) | {"words": words}}


def check_photos(path: Path) -> dict[str, Any]:
    """Read every photo."""
    return {"suffix": ".zip", "found": _describe(path, AssetKind.PHOTOS)}


def check_lift(path: Path, cameras: Path | None = None) -> dict[str, Any]:
    """Read every number of a lift, and limit its metadata; its names of views must be valid in queries.

    ``cameras`` are an asset that stands for those that it was made with: they must see what these saw.
    """
    lift = load_lift(path)
    arrays, parsed = lift.arrays(), lift.metadata
    metadata = finite(json.loads(parsed.model_dump_json()))
    if cameras is not None and not lift.has_cameras(cameras):
        got = "others" if parsed.poses else "a lift that does not tell what its cameras saw"
        hint = "bring the folder or file that was lifted with; a zip of the folder will do"
        if not parsed.poses:
            hint = "leave ?cameras= out, and PUT the camera file that it was made with; or lift again"
        raise InvalidLift("cameras", expected="cameras that see what the lift's did", got=got, hint=hint)
    for name, values in arrays.items():
        for first in range(0, len(values), BLOCK_ROWS):
            if not np.isfinite(values[first : first + BLOCK_ROWS]).all():
                raise InvalidLift("lift", expected="finite numbers", got=f"others in {name!r} from row {first} on")
    if "object" in arrays and (missing := set(range(len(arrays["object_views"]))) - set(np.unique(arrays["object"]))):
        raise InvalidLift("lift", expected="splats of each object", got=f"none of object {min(missing)}")
    require_texts("view name", metadata["views"], models.VIEW_CHARACTERS, InvalidLift)
    require_texts("word", metadata["words"], models.WORD_CHARACTERS, InvalidLift)
    if None in metadata["timings"].values():  # JSON has no infinite numbers
        raise InvalidLift("lift", expected="finite timings", got="others", hint="a list of lifts tells them")
    brief = len(json.dumps({name: value for name, value in metadata.items() if name not in LONG}))
    if brief > SHOWN_BYTES:
        expected = f"at most {SHOWN_BYTES} bytes of metadata beside the names of views and the words"
        raise InvalidLift("lift", expected=expected, got=f"{brief}")
    count, channels = arrays["features"].shape
    description = {"count": count, "channels": channels, "metadata": metadata, "warnings": []}
    return {"suffix": ".safetensors", "found": description}


CHECKS: dict[UploadKind, Callable[..., dict[str, Any]]] = {
    AssetKind.SPLATS: check_splats,
    AssetKind.CAMERAS: check_cameras,
    AssetKind.FEATURES: check_features,
    AssetKind.MASKS: check_masks,
    AssetKind.TABLE: check_table,
    AssetKind.PHOTOS: check_photos,
    LIFT: check_lift,
}


def check(kind_name: str, file: str, *arguments: str) -> dict[str, Any]:
    """Check one file of a kind: ``valid`` with its description, or ``invalid`` with the error.

    Args:
        arguments: of a lift, the path of its cameras if these have another digest than the lift has stored.
    """
    kind: UploadKind = LIFT if kind_name == LIFT else AssetKind(kind_name)
    path = Path(file)
    try:
        result = CHECKS[kind](path, *map(Path, arguments))
        require_texts("view name", result["found"].get("names", ()), models.VIEW_CHARACTERS, INVALID[kind])
        require_texts("word", result["found"].get("words", ()), models.WORD_CHARACTERS, INVALID[kind])
    except SplatliftError as error:
        return _invalid(_of_another_kind(kind, path) or error, kind, path)
    except MemoryError:
        return _invalid(_out_of_memory(kind), kind, path)
    counts = finite(result["found"])  # norms of float32 rows may be infinite
    return {
        "event": "valid",
        "suffix": result["suffix"],
        "warnings": [str(warning) for warning in counts.pop("warnings")],
        "counts": counts,
    }


def _invalid(error: SplatliftError, kind: UploadKind, path: Path) -> dict[str, Any]:
    names = {str(path): kind, f"text table {path.name}": kind, tempfile.gettempdir(): "the server's temporary folder"}
    return {"event": "invalid", "fault": fault_of(error, names)}


def _of_another_kind(kind: UploadKind, path: Path) -> InvalidInput | None:
    """Return a hint for a file of another kind; None if it looks right, or unknown."""
    identity = identify(path)
    actual = identity.kind
    if identity.suffix in (".sog", ".zip") and not zipfile.is_zipfile(path):
        got, hint = "the document of a SOG without its pictures", "zip it with them, and send that"
        return INVALID[kind](kind, expected=f"a file of {kind}", got=got, hint=hint)
    if actual is None:
        return wrong_kind(path, kind, INVALID[kind], argument=kind, expected=f"a file of {kind}")
    hint = "POST it to /lifts" if actual == LIFT else f"PUT it to /assets/{actual}"
    return (
        None
        if actual == kind
        else INVALID[kind](kind, expected=f"a file of {kind}", got=f"one of {actual}", hint=hint)
    )


def _out_of_memory(kind: UploadKind) -> InvalidInput:
    return INVALID[kind](kind, expected="a file that fits the memory of a check", got="one that needs more")


def rename(pack: str, changes: str, header: str) -> dict[str, Any]:
    """Write the length and the header of a checked pack with other names: ``valid``, or ``invalid`` with the error.

    Args:
        changes: the names, a JSON object. header: the file to write.
    """
    path = Path(pack)
    try:
        read_features(path)  # it may have changed since it was stored
    except SplatliftError as error:
        return _invalid(error, AssetKind.FEATURES, path)
    Path(header).write_bytes(next(with_metadata(path, json.loads(changes))))
    return {"event": "valid"}


def plan(file: str) -> dict[str, Any]:
    """Plan the order of a job, a JSON file: ``valid`` with the plan, or ``invalid`` with the error."""
    order = json.loads(Path(file).read_bytes())
    try:
        settings = LiftSettings.of(**order["settings"])
        files = order["splats"], order["cameras"], order["features"]
        lift_plan = plan_files(*files, settings, in_blocks=order["engine"] is not None)
        return {"event": "valid", "plan": plan_document(lift_plan, order["names"])}
    except SplatliftError as error:
        return {"event": "invalid", "fault": fault_of(error, order["names"])}


# Work of jobs: a lift, or a trade-off


def lift_as_ordered(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Lift, and write the lift to ``output``.

    Returns:
        Fields of the job's last message.

    Raises:
        SplatliftError: as `liftcore.lift` has it.
    """

    def planned(plan: Plan) -> None:
        for warning in plan.warnings:  # also in the operator's log
            log.warning(warning)
        report.plan(plan_document(plan, order["names"]))

    settings = LiftSettings.of(**order["settings"])
    address = order["ray_address"] if order["engine"] == "ray" else None
    engine = open_engine(order["engine"], address, order["threads"])
    lift = lift_files(
        Path(order["splats"]),
        Path(order["cameras"]),
        [Path(path) for path in order["features"]],
        settings,
        threads=order["threads"],
        progress=report,
        on_plan=planned,
        checkpoint=Checkpoint(Path(order["work"]), order["checkpoint_seconds"]),
        engine=engine,
    )
    lift = _as_clients_know(lift, order["file_names"])
    output = Path(order["output"])
    lift.save(output, progress=report)
    return {
        "sha256": sha256_of(output),
        "count": lift.features.shape[0],
        "channels": lift.features.shape[1],
        # Through JSON, not model_dump: infinite numbers must become null.
        "metadata": json.loads(lift.metadata.model_dump_json()),
    }


def plan_document(plan: Plan, names: Mapping[str, str]) -> dict[str, Any]:
    """Return a plan as `service.models.Plan` has it, with clients' names in place of paths."""
    warnings = [replace_names(warning, names) for warning in (*plan.warnings, *plan.input_warnings)]
    return finite({"summary": list(plan.summary()), "warnings": warnings, **plan.facts()})


def _as_clients_know(lift: LiftResult, names: Mapping[str, str]) -> LiftResult:
    """Return the inputs by the names of clients' downloads: a lift finds them beside it, without private paths."""
    metadata = lift.metadata
    resolved = {str(Path(path).resolve()): name for path, name in names.items()}  # data may be behind a link
    inputs = metadata.splats, metadata.cameras, *metadata.features
    splats, cameras, *features = (
        file.model_copy(update={"path": resolved[str(Path(file.path).resolve())]}) for file in inputs
    )
    update = {"splats": splats, "cameras": cameras, "features": tuple(features)}
    return replace(lift, metadata=metadata.model_copy(update=update))


def compare_as_ordered(order: dict[str, Any], progress: Reporter) -> dict[str, Any]:
    """Compare, and draw the chart to ``output``. Each run is a process of this group, with this environment.

    Returns:
        Fields of the job's last message: ``document`` and ``page``.

    Raises:
        SplatliftError: as `liftcore.evaluate.compare_speeds` has it.
    """
    from liftcore.evaluate import SceneFiles, compare_speeds  # imports matplotlib, which lifts do not need

    settings, parameters, labels = order["settings"], order["parameters"], order["labels"]
    files = Path(order["splats"]), Path(order["cameras"]), tuple(Path(path) for path in order["features"])
    scene = SceneFiles(*files)
    if labels:
        classes = tuple(parameters["labels"]["classes"])
        scene = SceneFiles(*files, Path(labels["masks"]), Path(labels["table"]), classes)
    tradeoff = compare_speeds(
        scene,
        budget=parameters["budget_s"],
        settings=settings,
        kernel=Kernel(order["kernel"]),
        threads=order["threads"],
        progress=progress,
        scene=f"splats {scene.splats.stem[:SHOWN_DIGITS]}",  # a blob's name is its digest
        command=f"POST /tradeoff {json.dumps(parameters | {'settings': settings})}",
    )
    with tempfile.TemporaryDirectory(prefix="splatlift-chart-") as folder:
        chart = next(file for file in tradeoff.save(Path(folder)) if file.suffix == ".png")
        Path(order["output"]).write_bytes(chart.read_bytes())
    return {"document": tradeoff.document, "page": "\n".join(tradeoff.lines()) + "\n"}
