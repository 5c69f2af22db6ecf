"""Run an experiment on a scene: its document, a table for people, JSON and a plot."""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import hardware
from tests.benchmarks.experiments.figure import save_experiment
from tests.benchmarks.experiments.subject import Subject


def run_experiment(name: str, scene: Path, out: Path, every: int = 1) -> dict[str, Any]:
    """Measure, and write ``out/NAME-SCENE.json`` and ``out/NAME-SCENE.png``.

    Args:
        name: a module of this package: ``fidelity`` for ``fidelity.py``.
        scene: a folder with ``point_cloud.ply``, cameras and feature packs.
        every: take every n-th feature view only.

    Raises:
        InvalidInput: the scene lacks what the experiment needs.
    """
    if not (scene / "point_cloud.ply").is_file():
        raise InvalidInput("scene", expected="a folder with point_cloud.ply and cameras", got=str(scene))
    module = importlib.import_module(f"tests.benchmarks.experiments.{name}")
    start = time.perf_counter()
    found = module.measure(Subject(scene, every))
    if not found["rows"]:
        wanted = ", ".join(f"{pack}.safetensors" for pack in module.PACKS)
        raise InvalidInput("scene", expected=f"a folder with one of {wanted}", got=f"{scene} with none of them")
    document = {
        "experiment": name,
        "title": module.TITLE,
        "source": module.SOURCE,
        "scene": scene.resolve().name,
        "every_nth_view": every,
        "note": "",
        **found,
        "command": f"splatlift experiment {name} {scene}" + (f" --every {every}" if every > 1 else ""),
        "date": datetime.now(UTC).date().isoformat(),
        "seconds": time.perf_counter() - start,
        "hardware": hardware(),
    }
    files = save_experiment(f"{name}-{document['scene']}", document, module.draw, out)
    return document | {"files": [str(file) for file in files]}


def table_of(document: Mapping[str, Any]) -> list[str]:
    """The rows as a Markdown table."""
    columns = document["columns"]
    head = [" | ".join(str(column).replace("_", " ") for column in columns), "|".join("---" for _ in columns)]
    rows = [" | ".join(_cell(row[column]) for column in columns) for row in document["rows"]]
    return [f"| {line} |" if "---" not in line else f"|{line}|" for line in head + rows]


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
