"""What a scene folder holds: splats, cameras, a feature pack, words, and the truth where somebody knows it."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.query.text import BUILT_IN, NO_WORDS, OWN_WORDS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_SPLATS = (".ply", ".sog", ".spz", ".splat")  # the first kind that is there
_CAMERA_FILES = ("cameras.json", "transforms.json", "cameras.zip")
_TABLE = "text_table.safetensors"
_ENCODERS = {space: encoder for encoder, space in BUILT_IN.items()}
_PHRASES = 3  # asked when nobody says which


@dataclass(frozen=True)
class Truth:
    """What is really there."""

    names: tuple[str, ...]  # object names
    masks: Mapping[str, np.ndarray]  # view -> [H, W] integers, rows of names; -1 = none
    meant: Mapping[str, tuple[str, ...]]  # phrase -> the objects that it means, none where it means nothing here
    asked: tuple[str, ...]  # phrases that the scene is to be asked

    def mask_of(self, phrase: str, view: str) -> np.ndarray | None:
        """[H, W] bool, where the phrase's objects are; None when the phrase or the view has no truth."""
        if phrase not in self.meant or view not in self.masks:
            return None
        rows = [self.names.index(name) for name in self.meant[phrase]]
        return np.isin(self.masks[view], rows)

    def name_of(self, masks: Mapping[str, np.ndarray]) -> str | None:
        """The object that most pixels of these masks [H, W] bool show; None where they show none."""
        shown = np.concatenate([self.masks[view][mask] for view, mask in masks.items() if view in self.masks])
        known = shown[shown >= 0]
        return self.names[int(np.bincount(known).argmax())] if len(known) else None

    def mean_iou(self, phrase: str, masks: Mapping[str, np.ndarray]) -> float | None:
        """Mean intersection over union of masks [H, W] bool, over the views that show what the phrase means."""
        pairs = [(mask, self.mask_of(phrase, view)) for view, mask in masks.items()]
        shown = [(mask, meant) for mask, meant in pairs if meant is not None and meant.any()]
        values = [(mask & meant).sum() / (mask | meant).sum() for mask, meant in shown]
        return float(np.mean(values)) if values else None


@dataclass(frozen=True)
class DemoScene:
    """A scene ready for the service."""

    name: str
    splats: Path
    cameras: Path
    features: Path
    encoder: str  # specification of the text encoder
    text_space: str  # of the features; "none" when no text encoder shares it, "" when the pack does not say
    phrases: tuple[str, ...]  # empty = nothing can be asked, or nobody knows what
    views: tuple[str, ...]  # to look from, the pictured one first; views with truth where there are any
    truth: Truth | None


def find_scene(folder: Path, phrases: Sequence[str], scratch: Path) -> DemoScene:
    """A scene folder as it is: the files are found by name, a COLMAP model is zipped for the upload.

    Args:
        folder: holds splats (``.ply``, ``.sog``, ``.spz`` or ``.splat``), cameras (``cameras.json``,
            ``transforms.json``, ``sparse/0``) and a pack.
        phrases: what to ask; empty = what ``truth.json`` says, else three of its objects, and nothing where the
            features have no words.
        scratch: where to put the zipped model.

    Raises:
        InvalidInput: something is missing, or there are no words to ask the phrases with; the error says what.
    """
    if not folder.is_dir():
        raise InvalidInput("--scene", expected="a folder", got=f"nothing at {folder}")
    truth = _read_truth(folder)
    cameras = _cameras(folder, scratch)
    table, features = folder / _TABLE, _features(folder)
    text_space = _text_space(features, table)
    askable = table.is_file() or text_space in (*_ENCODERS, OWN_WORDS)
    if phrases and not askable:
        raise InvalidInput(
            "--ask", expected=f"words in the space of the features, as {_TABLE} in {folder.name}",
            got=f"none, and features of the text space {text_space!r}",
            hint="or use 'splatlift lift' and 'splatlift query --encoder', which take any text encoder",
        )  # fmt: skip
    return DemoScene(
        name=folder.name,
        splats=_splats(folder),
        cameras=cameras,
        features=features,
        encoder=f"table:{table}" if table.is_file() else _ENCODERS.get(text_space, next(iter(BUILT_IN))),
        text_space=text_space,
        phrases=tuple(phrases) or (truth.asked if truth and askable and text_space != NO_WORDS else ()),
        views=tuple(truth.masks) if truth else _some_views(cameras),
        truth=truth,
    )


def _splats(folder: Path) -> Path:
    """The splats of a folder, or of the last iteration that a 3DGS trainer kept in it."""
    for suffix in _SPLATS:
        found = sorted(folder.glob(f"*{suffix}")) or sorted(folder.glob(f"point_cloud/*/*{suffix}"))
        if found:
            return found[-1]
    raise InvalidInput(f"splats of {folder.name}", expected=f"a file of {', '.join(_SPLATS)}", got="none")


def _cameras(folder: Path, scratch: Path) -> Path:
    """The one file of the cameras; of several, such as a COLMAP model's, a zip in ``scratch``."""
    from liftcore.io.cameras import camera_source

    named = [folder / name for name in _CAMERA_FILES if (folder / name).is_file()]
    files = [file for file in camera_source(named[0] if named else folder).files if file.is_file()]
    if not files:
        wanted = ", ".join([*_CAMERA_FILES, "sparse/0"])
        raise InvalidInput(f"cameras of {folder.name}", expected=f"one of {wanted}", got="none")
    if len(files) == 1:
        return files[0]
    scratch.mkdir(parents=True, exist_ok=True)
    packed = scratch / "cameras.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return packed


def _features(folder: Path) -> Path:
    from safetensors import SafetensorError, safe_open

    preferred = folder / "features.safetensors"
    for path in [preferred, *sorted(folder.glob("*.safetensors"))]:
        try:
            with safe_open(str(path), framework="pt") as handle:
                names = list(handle.keys())
                if any(name.endswith(("/codebook", "/grid")) for name in names):
                    return path
        except (SafetensorError, OSError):
            continue
    raise InvalidInput(f"features of {folder.name}", expected="a feature pack (.safetensors)", got="none")


def _text_space(features: Path, table: Path) -> str:
    """What the pack says; a pack that says nothing has words if a table of them lies beside it."""
    from safetensors import safe_open

    with safe_open(str(features), framework="pt") as handle:
        told = (handle.metadata() or {}).get("text_space")
    return told or ("" if table.is_file() else NO_WORDS)


def _read_truth(folder: Path) -> Truth | None:
    """``truth.json``: the objects, what to ask, what phrases mean; ``truth.safetensors``: ``VIEW/mask``."""
    from safetensors.numpy import load_file

    names_file, arrays_file = folder / "truth.json", folder / "truth.safetensors"
    if not (names_file.is_file() and arrays_file.is_file()):
        return None
    document = json.loads(names_file.read_text())
    arrays = load_file(arrays_file)
    names = tuple(str(thing["class"]) for thing in document["objects"])
    meant = {f"the {name}": (name,) for name in names} | {name: (name,) for name in names}
    masks = {key.removesuffix("/mask"): mask for key, mask in arrays.items() if key.endswith("/mask")}
    return Truth(
        names=names,
        masks={view: masks[view] for view in document.get("held_out_views", masks)},
        meant=meant | {phrase: tuple(things) for phrase, things in document.get("phrases", {}).items()},
        asked=tuple(document.get("ask", [f"the {name}" for name in names[:_PHRASES]])),
    )


def _some_views(cameras: Path) -> tuple[str, ...]:
    from liftcore.io.cameras import read_cameras

    views = [camera.name for camera in read_cameras(cameras).values()]
    return (views[len(views) // 2],)
