"""3D-OVS labels: ``SCENE/segmentations/classes.txt`` and ``SCENE/segmentations/VIEW/CLASS.png``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, UnidentifiedImageError

from liftcore.errors import InvalidInput
from liftcore.evaluate.protocols import LabelledObject

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.evaluate.protocols import Box

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
        """Every class at the camera's size; one without a mask is nowhere in the view.

        Raises:
            InvalidInput: a mask is no image, or the view has masks of none of the classes.
        """
        folder = self.folders[view]
        found = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _SUFFIXES}
        if not any(name in found for name in self.classes):
            got = ", ".join(sorted(found)[:3]) or "no images"
            raise InvalidInput(str(folder), expected=f"masks named like the classes of {_CLASSES}", got=got)
        masks = {
            name: _mask(found[name], width, height) if name in found else np.zeros((height, width), bool)
            for name in self.classes
        }
        return [LabelledObject(name, mask, _boxes(mask)) for name, mask in masks.items()]


def three_d_ovs_scenes(data: Path) -> dict[str, ThreeDOvsScene]:
    """Scene name -> its labels, of the dataset's folder or of one scene's.

    Raises:
        InvalidInput: there are none, or a list of classes is empty or is no text.
    """
    roots = [data, *sorted(path for path in data.iterdir() if path.is_dir())] if data.is_dir() else []
    found = {}
    for root in roots:
        labels = root / "segmentations"
        if (labels / _CLASSES).is_file():
            views = {path.name: path for path in sorted(labels.iterdir()) if path.is_dir()}
            name = root.resolve().name
            found[name] = ThreeDOvsScene(name, _classes(labels / _CLASSES), views)
    if not found:
        expected = f"3D-OVS with SCENE/segmentations/{_CLASSES}"
        raise InvalidInput("--data", expected=expected, got=f"none in {data}")
    return found


def _classes(path: Path) -> tuple[str, ...]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(str(path), expected="a class a line", got=str(error)[:120]) from None
    names = tuple(dict.fromkeys(line.strip() for line in lines if line.strip()))
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
