"""LeRF-OVS labels: ``label/SCENE/frame_*.json``, polygons as the annotation tool ISAT writes them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw

from liftcore.errors import InvalidInput
from liftcore.evaluate.protocols import LabelledObject

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.evaluate.protocols import Box

BACKGROUND = "__background__"  # ISAT's own category, which asks for nothing
MAX_COORDINATE = 1e6  # pixels; what lies beyond is no place on an image

Polygon = list[tuple[int, int]]  # x y, pixels


@dataclass(frozen=True)
class LerfScene:
    """The labelled frames of a scene (``LabelledScene``)."""

    name: str
    files: dict[str, Path]  # view -> its JSON

    @property
    def views(self) -> tuple[str, ...]:
        """The labelled frames."""
        return tuple(self.files)

    def objects(self, view: str, width: int, height: int) -> list[LabelledObject]:
        """The categories of a frame, each the union of its polygons, rescaled to the camera's size.

        Polygons cover their outlines too, as the field's scripts draw them.

        Raises:
            InvalidInput: the file is no ISAT JSON.
        """
        path = self.files[view]
        document = _read(path)
        scale = (width / _side(document, "width", path), height / _side(document, "height", path))
        polygons: dict[str, list[Polygon]] = {}
        for entry in _list(document.get("objects"), path):
            category = entry.get("category") if isinstance(entry, dict) else None
            if not isinstance(category, str) or not category.strip():
                raise InvalidInput(str(path), expected="a category in every object", got=repr(category))
            if category != BACKGROUND:
                points = _polygon(entry.get("segmentation"), scale, path)
                polygons.setdefault(category, []).extend([points] if points else [])
        return [
            LabelledObject(category, _filled(parts, width, height), tuple(_box(part) for part in parts))
            for category, parts in polygons.items()
        ]


def lerf_scenes(data: Path) -> dict[str, LerfScene]:
    """Scene name -> its labels, of the dataset's folder, its ``label`` folder, or one scene's folder of labels.

    Raises:
        InvalidInput: there are none.
    """
    root = data / "label" if (data / "label").is_dir() else data
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    found = {}
    for folder in [*folders, root]:
        files = {path.stem: path for path in sorted(folder.glob("*.json"))}
        if files:
            found[folder.name] = LerfScene(folder.name, files)
    if not found:
        raise InvalidInput("--data", expected="LeRF-OVS with label/SCENE/frame_*.json", got=f"none in {data}")
    return found


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InvalidInput(str(path), expected="labels as JSON (ISAT)", got=str(error)[:120]) from None
    if not isinstance(document, dict):
        raise InvalidInput(str(path), expected="a JSON object (ISAT)", got=type(document).__name__)
    return document


def _side(document: dict[str, Any], side: str, path: Path) -> int:
    info = document.get("info")
    value = info.get(side) if isinstance(info, dict) else None
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidInput(f"{path} info.{side}", expected="pixels of the labelled image", got=repr(value))
    return value


def _list(value: object, path: Path) -> list[Any]:
    if not isinstance(value, list):
        raise InvalidInput(str(path), expected="a list of objects and of points", got=repr(value)[:80])
    return value


def _polygon(points: object, scale: tuple[float, float], path: Path) -> Polygon:
    corners = []
    for point in _list(points, path):
        if not _is_place(point):
            raise InvalidInput(str(path), expected="points [x, y] in pixels", got=repr(point)[:80])
        corners.append((math.floor(point[0] * scale[0]), math.floor(point[1] * scale[1])))
    return corners


def _is_place(point: Any) -> bool:
    return (
        isinstance(point, list)
        and len(point) == 2
        and all(isinstance(number, int | float) and abs(number) <= MAX_COORDINATE for number in point)
    )


def _filled(polygons: list[Polygon], width: int, height: int) -> np.ndarray:
    canvas = Image.new("1", (width, height))
    for polygon in polygons:
        if len(polygon) > 1:
            ImageDraw.Draw(canvas).polygon(polygon, fill=1, outline=1)
        else:
            ImageDraw.Draw(canvas).point(polygon, fill=1)
    return np.asarray(canvas, dtype=bool)


def _box(polygon: Polygon) -> Box:
    columns, rows = zip(*polygon, strict=True)
    return min(columns), min(rows), max(columns), max(rows)
