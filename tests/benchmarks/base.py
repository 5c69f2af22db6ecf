"""What the benchmarks share: lifts from files, tables, and the machine that took the figures."""

import argparse
import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.io.lift_file import save_lift
from liftcore.io.scene_files import lift_files as lift_paths
from liftcore.query.scene import QueryScene
from liftcore.raster.base import Raster
from liftcore.result import LiftResult
from liftcore.settings import LiftSettings

PACKS = ("features", "features_hard", "features_clean", "grids")  # of tabletop
PRESETS = ("row-sum", "tikhonov")


def cameras_of(folder: Path) -> Path:
    """What the cameras of a scene folder are read from: ``cameras.json`` if it is there, else the folder."""
    inria = folder / "cameras.json"
    return inria if inria.is_file() else folder


def scene_files(folder: Path, pack: str = "features") -> tuple[Path, Path, Path]:
    """Splats, cameras and a feature pack of a scene folder."""
    return folder / "point_cloud.ply", cameras_of(folder), folder / f"{pack}.safetensors"


def lift_files(files: Sequence[Path], **settings: Any) -> LiftResult:
    """A lift of splats, cameras and packs, without the certificate unless the settings ask for it."""
    return lift_paths(files[0], files[1], list(files[2:]), LiftSettings.of(**{"certificate_rays": 0, **settings}))


def opened(made: LiftResult, raster: Raster | None = None) -> QueryScene:
    """A lift to ask questions of, with a raster of its splats that is there already."""
    with tempfile.TemporaryDirectory() as place:
        save_lift(made, Path(place) / "lift.safetensors")
        scene = QueryScene(made)
        if raster is not None:
            scene.raster = raster
        _ = scene.cameras
    return scene


def class_scores(features: Tensor, classes: Tensor) -> Tensor:
    """Cosine of every splat with every class vector: features [P, F], classes [K, F] unit -> [P, K] f32."""
    parts = []
    for block in features.split(65_536):
        rows = block.to(torch.float32)
        norms = torch.linalg.vector_norm(rows, dim=1, keepdim=True).clamp_min(1e-12)
        parts.append(rows / norms @ classes.to(torch.float32).T)
    return torch.cat(parts)


def splat_accuracy(scores: Tensor, truth: Tensor, counted: Tensor) -> float:
    """Share of the counted splats [P] bool whose best class equals the truth [P]."""
    return float((scores.argmax(dim=1) == truth.long())[counted].float().mean())


def mask_iou(mask: Tensor | np.ndarray, truth: Tensor | np.ndarray) -> float:
    """Intersection over union of two masks [H, W] bool; one where both are empty."""
    mask, truth = torch.as_tensor(mask), torch.as_tensor(truth)
    union = int((mask | truth).sum())
    return int((mask & truth).sum()) / union if union else 1.0


def command_line(module: str, doc: str | None, *arguments: Sequence[Any]) -> argparse.ArgumentParser:
    """A parser with ``--json``; ``arguments`` are (name, options) of `add_argument`."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, options in arguments:
        parser.add_argument(name, **options)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    return parser


def table_of(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Rows as a Markdown table, columns as they first appear unless they are named."""
    rows = list(rows)
    columns = columns or list(dict.fromkeys(key for row in rows for key in row))
    lines = [[key.replace("_", " ") for key in columns], ["---"] * len(columns)]
    lines += [[_cell(row.get(key)) for key in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tell(rows: Iterable[Mapping[str, Any]], *, as_json: bool, note: str = "", columns: Sequence[str] = ()) -> None:
    """Print the rows with the machine: a Markdown table, or one JSON object."""
    rows = list(rows)
    if as_json:
        print(json.dumps({"rows": rows, "note": note, "hardware": hardware()}))
        return
    print(table_of(rows, columns))
    print("\n".join(["", *([note] if note else []), machine_line(hardware())]))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value).replace("|", "/")
