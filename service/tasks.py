"""What children do: checks and plans while a request waits, and the work of jobs.

A task is a function of an order and a reporter; it returns the result as JSON, or raises the error that is reported.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore import (
    Kernel,
    LiftResult,
    LiftSettings,
    Plan,
    errors,
    lift_files,
    load_lift,
    open_engine,
    plan_files,
    read_features,
)
from liftcore.errors import InvalidFeatures, InvalidInput, InvalidLift, SplatliftError
from liftcore.evaluate import inspect_file
from liftcore.files import finite, identify, is_zip, wrong_kind
from liftcore.text.table import TableEncoder
from service.errors import replace_names
from service.models import FILE_CHARACTERS, VIEW_CHARACTERS, WORD_CHARACTERS
from service.process import NICENESS

if TYPE_CHECKING:
    from service.process import Reporter

BLOCK_ROWS = 1 << 14  # of a lift, checked at a time
SHOWN_CHARACTERS = 256 << 10  # of names or words in the counts of an asset; more are left out
SHOWN_BYTES = 64 << 10  # of a lift's metadata in the database; of more, names of views and words are left out
SHOWN_DIGITS = 12  # of the splats' digest, in the title of a trade-off's chart
Order = dict[str, Any]

log = logging.getLogger(__name__)


# Checks of uploads


def check(order: Order, report: Reporter) -> dict[str, Any]:
    """Check one file of a kind whole; return its ``suffix``, ``counts`` and ``warnings``."""
    kind, path = order["kind"], Path(order["file"])
    try:
        if kind == "lift":
            return check_lift(path, order.get("cameras"))
        extra = EXTRA_CHECKS.get(kind, lambda _: {})(path)
        description = inspect_file(path, kind, trusted=False)
        counts = {name: value for name, value in description.items() if name not in ("kind", "bytes")} | extra
        require_texts("view name", counts.get("names", ()), VIEW_CHARACTERS, error_class(kind))
        require_texts("word", counts.get("words", ()), WORD_CHARACTERS, error_class(kind))
    except SplatliftError as error:
        raise _of_another_kind(kind, path) or error from None
    except MemoryError:
        got, expected = "one that needs more", "a file that fits the memory of a check"
        raise error_class(kind)(kind, expected=expected, got=got) from None
    for name in ("names", "words"):
        if sum(map(len, counts.get(name, ()))) > SHOWN_CHARACTERS:
            del counts[name]
    warnings = [str(warning) for warning in counts.pop("warnings")]
    return {"suffix": _suffix(kind, path), "counts": finite(counts), "warnings": warnings}


def error_class(kind: str) -> type[InvalidInput]:
    """Return the class of errors of a malformed file, by its kind."""
    return getattr(errors, f"Invalid{kind.capitalize()}")


def _suffix(kind: str, path: Path) -> str:
    if kind == "splats":
        return identify(path).suffix
    if kind == "cameras":
        return ".zip" if is_zip(path) else ".json"
    return ".zip" if kind == "photos" else ".safetensors"


def require_texts(argument: str, texts: Sequence[str], longest: int, error: type[InvalidInput]) -> None:
    """Require names or words of a length that a query can have, and lists of a limited length."""
    for text in texts:
        if len(text) > longest or not (text or argument == "word"):  # a table may have a row without a word
            raise error(
                argument, expected=f"1 to {longest} characters",
                got=f"{len(text)}: {text[:40]!r}..." if text else "an empty one",
                hint="name each image, without folders where that is enough" if argument == "view name" else "",
            )  # fmt: skip
    if (total := sum(map(len, texts))) > FILE_CHARACTERS:
        limit = f"at most {FILE_CHARACTERS} characters of all together"
        raise error(argument, expected=limit, got=f"{total} in {len(texts)}", hint="several files hold more")


def check_pack(path: Path) -> dict[str, Any]:
    """Limit the words and the names that a feature pack brings."""
    packs = read_features(path)
    require_texts("word", packs.table.words if packs.table else (), WORD_CHARACTERS, InvalidFeatures)
    for name in ("encoder", "text_space"):
        if len(text := getattr(packs, name)) > WORD_CHARACTERS:
            expected = f"at most {WORD_CHARACTERS} characters"
            raise InvalidFeatures(name, expected=expected, got=f"{len(text)}: {text[:40]!r}...")
    return {}


EXTRA_CHECKS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "features": check_pack,
    "table": lambda path: {"words": list(TableEncoder.open(path).words)},
}


def check_lift(path: Path, cameras: str | None) -> dict[str, Any]:
    """Read every number of a lift, and limit its metadata; cameras that replace its own must see what those saw."""
    lift = load_lift(path)
    arrays, parsed = lift.arrays(), lift.metadata
    metadata = finite(json.loads(parsed.model_dump_json()))
    if cameras is not None and not lift.has_cameras(Path(cameras)):
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
    require_texts("view name", metadata["views"], VIEW_CHARACTERS, InvalidLift)
    require_texts("word", metadata["words"], WORD_CHARACTERS, InvalidLift)
    if None in metadata["timings"].values():  # JSON has no infinite numbers
        raise InvalidLift("lift", expected="finite timings", got="others", hint="a list of lifts tells them")
    return lift_content(path, lift, metadata)


def lift_content(path: Path, lift: LiftResult, metadata: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of a lift's row; of long metadata the names of views and the words are left out."""
    views = metadata["views"]
    if len(json.dumps(metadata)) > SHOWN_BYTES:
        metadata = metadata | {"views": [], "words": []}
        unseen = ("views_without_camera", "views_without_splats")
        diagnostics = {name: value for name, value in metadata["diagnostics"].items() if name not in unseen}
        metadata["diagnostics"] = diagnostics
    if (count := len(json.dumps(metadata))) > SHOWN_BYTES:
        expected = f"at most {SHOWN_BYTES} bytes of metadata beside the names of views and the words"
        raise InvalidLift("lift", expected=expected, got=f"{count}")
    metadata["view_count"] = len(views)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"sha256": digest, "count": len(lift), "channels": lift.rows.shape[1], "metadata": metadata}


def _of_another_kind(kind: str, path: Path) -> InvalidInput | None:
    """Return the error for a file of another kind; None if it looks right, or unknown."""
    identity, expected, error = identify(path), f"a file of {kind}", error_class(kind)
    if identity.suffix in (".sog", ".zip") and not is_zip(path):
        got, hint = "the document of a SOG without its pictures", "zip it with them, and send that"
        return error(kind, expected=expected, got=got, hint=hint)
    if identity.kind is None:
        return wrong_kind(path, kind, error, argument=kind, expected=expected)
    if identity.kind == kind:
        return None
    hint = "POST it to /lifts" if identity.kind == "lift" else f"PUT it to /assets/{identity.kind}"
    return error(kind, expected=expected, got=f"one of {identity.kind}", hint=hint)


# Plans and jobs


def plan(order: Order, report: Reporter) -> dict[str, Any]:
    """Return the plan of a lift, as `service.models.Plan` has it."""
    files = order["splats"], order["cameras"], order["features"]
    settings = LiftSettings.of(**order["settings"])
    return _document(plan_files(*files, settings, in_blocks=order["engine"] is not None), order["names"])


def _document(plan: Plan, names: Mapping[str, str]) -> dict[str, Any]:
    warnings = [replace_names(warning, names) for warning in plan.warnings]
    return finite({"summary": list(plan.summary()), "warnings": warnings, **plan.facts()})


def lift(order: Order, report: Reporter) -> dict[str, Any]:
    """Lift to ``output``; return the columns of the lift's row."""

    def report_plan(plan: Plan) -> None:
        for warning in plan.warnings:  # also in the operator's log
            log.warning(warning)
        report.say({"plan": _document(plan, order["names"])})

    os.nice(NICENESS)
    lift = lift_files(
        Path(order["splats"]),
        Path(order["cameras"]),
        [Path(path) for path in order["features"]],
        LiftSettings.of(**order["settings"]),
        threads=order["threads"],
        progress=report,
        on_plan=report_plan,
        checkpoint=order["work"],
        engine=open_engine(order["engine"], "auto" if order["engine"] == "ray" else None, order["threads"]),
    )
    lift, output = _as_clients_know(lift, order["file_names"]), Path(order["output"])
    lift.save(output, progress=report)
    saved_lift = load_lift(output)  # its metadata say how features are kept
    # Through JSON, not model_dump: infinite numbers must become null.
    return lift_content(output, saved_lift, json.loads(saved_lift.metadata.model_dump_json()))


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


def tradeoff(order: Order, report: Reporter) -> dict[str, Any]:
    """Compare, and draw the chart to ``output``. Each run is a process of this group, with this environment."""
    from liftcore.evaluate import SceneFiles, compare_speeds  # imports matplotlib, which lifts do not need

    os.nice(NICENESS)
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
        progress=report,
        scene=f"splats {scene.splats.stem[:SHOWN_DIGITS]}",  # a blob's name is its digest
        command=f"POST /tradeoff {json.dumps(parameters | {'settings': settings})}",
    )
    with tempfile.TemporaryDirectory(prefix="splatlift-chart-") as folder:
        chart = next(file for file in tradeoff.save(Path(folder)) if file.suffix == ".png")
        Path(order["output"]).write_bytes(chart.read_bytes())
    return {"document": tradeoff.document, "page": "\n".join(tradeoff.lines()) + "\n"}
