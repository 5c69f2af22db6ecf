"""Helpers of the benchmarks: scene folders, tables, and the machine of the figures."""

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import liftcore as lc
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.values.views import ViewFeatures


def cameras_of(folder: Path) -> Path:
    """Return the path of a scene folder's cameras: ``cameras.json`` if it exists, else the folder."""
    inria = folder / "cameras.json"
    return inria if inria.is_file() else folder


def scene_files(folder: Path, pack: str = "features") -> tuple[Path, Path, Path]:
    """Splats, cameras and a feature pack of a scene folder."""
    return folder / "point_cloud.ply", cameras_of(folder), folder / f"{pack}.safetensors"


def read_scene(folder: Path) -> tuple[lc.Splats, lc.Cameras]:
    """Splats and cameras of a scene folder."""
    splats, cameras, _ = scene_files(folder)
    return lc.read_splats(splats), lc.read_cameras(cameras)


def read_pack(folder: Path, name: str, stride: int = 1) -> Mapping[str, ViewFeatures]:
    """Every n-th view of a feature pack of a scene folder; the pack itself where that is all of them."""
    views = lc.read_features(folder / f"{name}.safetensors")
    return views if stride == 1 else {view: views[view] for view in views.views[::stride]}


def box_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Volume of the intersection over that of the union of two boxes [2, d], corners; 0 where both are flat."""
    sides = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
    common = float(np.prod(np.maximum(sides, 0)))
    union = float(np.prod(a[1] - a[0]) + np.prod(b[1] - b[0])) - common
    return common / union if union > 0 else 0.0


def command_line(module: str, doc: str | None, *arguments: Sequence[Any]) -> argparse.ArgumentParser:
    """A parser with ``--json``; ``arguments`` are (name, options) of `add_argument`."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, options in arguments:
        parser.add_argument(name, **options)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    return parser


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as a Markdown table, columns as they first appear."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = [[key.replace("_", " ") for key in columns], ["---"] * len(columns)]
    lines += [[_cell(row.get(key)) for key in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def print_rows(rows: Iterable[Mapping[str, Any]], *, as_json: bool, note: str = "") -> None:
    """Print the rows with the machine: a Markdown table, or one JSON object."""
    rows = list(rows)
    if as_json:
        print(json.dumps({"rows": rows, "note": note, "hardware": hardware()}))
        return
    print(table_of(rows))
    print("\n".join(["", *([note] if note else []), machine_line(hardware())]))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value).replace("|", "/")
