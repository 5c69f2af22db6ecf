"""Labels of the field's data sets: polygons of LeRF-OVS, masks of 3D-OVS.

- LeRF-OVS: ``label/SCENE/frame_*.json``, polygons as the annotation tool ISAT writes them.
- 3D-OVS: ``SCENE/segmentations/classes.txt`` and ``SCENE/segmentations/VIEW/CLASS.png``.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image, ImageDraw, UnidentifiedImageError

from liftcore.errors import InvalidInput, reading
from liftcore.features.mask_files import read_polygons
from liftcore.io.files import is_system_file, visible_files
from liftcore.scene.views import composed

ISAT_BACKGROUND = "__background__"
Box = tuple[int, int, int, int]  # x1 y1 x2 y2, pixels, both ends inside


@dataclass(frozen=True)
class LabelledObject:
    """The ground truth of a category in a frame."""

    category: str  # the text of the query
    mask: np.ndarray  # [H, W] bool, at the camera's size
    boxes: tuple[Box, ...]  # one a polygon


class LabelledScene(Protocol):
    """The ground truth of one scene."""

    @property
    def name(self) -> str:
        """The scene."""
        ...

    @property
    def views(self) -> tuple[str, ...]:
        """The labelled frames, by view name."""
        ...

    def objects(self, view: str, width: int, height: int) -> list[LabelledObject]:
        """Read the objects of a frame at the size of its camera [pixels]; a category is there once, and may be empty.

        Raises:
            InvalidInput: the labels are malformed.
        """
        ...


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
        """Read the categories of a frame, each the union of its polygons, rescaled to the camera's size.

        Polygons include their outlines, as in the field's scripts.

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
            if category != ISAT_BACKGROUND:
                parts = _polygons(entry.get("segmentation"), scale, path)
                polygons.setdefault(category, []).extend(part for part in parts if part)
        return [
            LabelledObject(category, _draw_polygons(parts, width, height), tuple(_box(part) for part in parts))
            for category, parts in polygons.items()
        ]


def lerf_scenes(data: Path) -> dict[str, LerfScene]:
    """Find scenes and their labels in the dataset's folder, its ``label`` folder, or one scene's folder of labels.

    Raises:
        InvalidInput: there are none.
    """
    root = data / "label" if (data / "label").is_dir() else data
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    scenes = {}
    for folder in [*folders, root]:
        files = {composed(path.stem): path for path in visible_files(folder, "*.json")}
        if files:
            scenes[folder.name] = LerfScene(folder.name, files)
    if not scenes:
        raise InvalidInput("data", expected="LeRF-OVS with label/SCENE/frame_*.json", got=f"none in {data}")
    return scenes


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


def _polygons(segmentation: object, scale: tuple[float, float], path: Path) -> list[Polygon]:
    """Read the parts of a polygon, in pixels of the camera."""
    with reading(path, InvalidInput, "polygons"):
        parts = read_polygons(segmentation)
    return [[(math.floor(x * scale[0]), math.floor(y * scale[1])) for x, y in part.tolist()] for part in parts]


def _draw_polygons(polygons: list[Polygon], width: int, height: int) -> np.ndarray:
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


_SUFFIXES = (".png", ".jpg", ".jpeg")
_CLASSES = "classes.txt"
HALF = 127  # of 8 bits: masks saved as JPEG are not quite 0 and 255


@dataclass(frozen=True)
class ThreeDOvsScene:
    """The labelled views of a scene (``LabelledScene``)."""

    name: str
    classes: tuple[str, ...]
    folders: dict[str, Path]  # view -> its folder of masks

    @property
    def views(self) -> tuple[str, ...]:
        """The labelled views."""
        return tuple(self.folders)

    def objects(self, view: str, width: int, height: int) -> list[LabelledObject]:
        """Read every class at the camera's size; one without a mask is not in the view.

        Raises:
            InvalidInput: a mask is no image, or the view has masks of none of the classes.
        """
        folder = self.folders[view]
        files = {composed(path.stem): path for path in visible_files(folder) if path.suffix.lower() in _SUFFIXES}
        if not any(name in files for name in self.classes):
            got = ", ".join(sorted(files)[:3]) or "no images"
            raise InvalidInput(str(folder), expected=f"masks named like the classes of {_CLASSES}", got=got)
        masks = {
            name: _mask(files[name], width, height) if name in files else np.zeros((height, width), bool)
            for name in self.classes
        }
        return [LabelledObject(name, mask, _boxes(mask)) for name, mask in masks.items()]


def three_d_ovs_scenes(data: Path) -> dict[str, ThreeDOvsScene]:
    """Find scenes and their labels in the dataset's folder or in one scene's.

    Raises:
        InvalidInput: there are none, or a list of classes is empty or is no text.
    """
    roots = [data, *sorted(path for path in data.iterdir() if path.is_dir())] if data.is_dir() else []
    scenes = {}
    for root in roots:
        labels = root / "segmentations"
        if (labels / _CLASSES).is_file():
            folders = [path for path in sorted(labels.iterdir()) if path.is_dir()]
            views = {composed(path.name): path for path in folders if not is_system_file(Path(path.name))}
            name = root.resolve().name
            scenes[name] = ThreeDOvsScene(name, _classes(labels / _CLASSES), views)
    if not scenes:
        expected = f"3D-OVS with SCENE/segmentations/{_CLASSES}"
        raise InvalidInput("data", expected=expected, got=f"none in {data}")
    return scenes


def _classes(path: Path) -> tuple[str, ...]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(str(path), expected="a class a line", got=str(error)[:120]) from None
    names = tuple(dict.fromkeys(composed(line.strip()) for line in lines if line.strip()))
    if not names:
        raise InvalidInput(str(path), expected="a class a line", got="none")
    return names


def _mask(path: Path, width: int, height: int) -> np.ndarray:
    try:
        with Image.open(path) as image:
            grey = np.asarray(image.convert("L"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InvalidInput(str(path), expected="a mask as an image", got=str(error)[:120]) from None
    # Some copies hold zeros and ones instead of black and white.
    inside = grey > (0 if grey.max(initial=0) <= 1 else HALF)
    if grey.shape == (height, width):
        return inside
    return np.asarray(Image.fromarray(inside).resize((width, height), Image.Resampling.NEAREST))


def _boxes(mask: np.ndarray) -> tuple[Box, ...]:
    if not mask.any():
        return ()
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return ((int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])),)
