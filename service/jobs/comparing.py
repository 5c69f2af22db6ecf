"""What a job of kind ``tradeoff`` does."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from liftcore.evaluate.tradeoff import SceneFiles, candidates_of, compare
from liftcore.evaluate.tradeoff_report import page_of, save
from liftcore.io.json_file import finite
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.runtime.device import Device, choose_device
from liftcore.runtime.progress import Progress, one_step
from liftcore.scene.splats import Kernel
from liftcore.values.settings import LiftSettings

SHOWN_DIGITS = 12  # of the splats' digest, by which the chart names the scene


def compare_as_ordered(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Compare, and draw the chart at ``output``. Each run is a process of our group, with our environment.

    Returns:
        What the job's last message tells of it: ``document`` and ``page``.

    Raises:
        SplatliftError: as `liftcore.evaluate.tradeoff.compare` has it.
    """
    scene, settings, parameters = _scene(order), order["settings"], order["parameters"]
    device = choose_device(settings.get("device", "auto"))
    with one_step(progress, "compile"):
        _compile(Kernel(order["kernel"]), device, settings)
    progress("tradeoff", 0, len(candidates_of(settings)), "runs")
    found = compare(scene, parameters["budget_s"], settings, order["threads"], progress)
    named = {
        "title": "Speed against accuracy",
        "scene": f"splats {scene.splats.stem[:SHOWN_DIGITS]}",  # a blob is named by its digest
        "command": f"POST /tradeoff {json.dumps(parameters | {'settings': settings})}",
    }
    document = finite(named | found)
    with tempfile.TemporaryDirectory(prefix="splatlift-chart-") as folder:
        chart = next(file for file in save(document, Path(folder)) if file.suffix == ".png")
        Path(order["output"]).write_bytes(chart.read_bytes())
    return {"document": document, "page": "\n".join(page_of(document)) + "\n"}


def _compile(kernel: Kernel, device: Device, settings: dict[str, Any]) -> None:
    """What the runs load: else the first of a kind on a machine eats up the budget."""
    for candidate in candidates_of(settings):
        warm_up_lift(kernel, device, LiftSettings.of(**settings | candidate.settings))


def _scene(order: dict[str, Any]) -> SceneFiles:
    files = Path(order["splats"]), Path(order["cameras"]), tuple(Path(path) for path in order["features"])
    labels = order["labels"]
    if not labels:
        return SceneFiles(*files)
    return SceneFiles(
        *files, Path(labels["masks"]), Path(labels["table"]), tuple(order["parameters"]["labels"]["classes"])
    )
