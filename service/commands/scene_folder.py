"""What a scene folder holds: splats, cameras, a feature pack, words, and the truth where somebody knows it."""

from __future__ import annotations

import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.io.files import visible_files
from liftcore.io.kinds import SPLATS_SENT, identify, kind_of
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS
from liftcore.values.pack import read_features

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SHIPPED = Path(__file__).with_name("tabletop")
_CAMERA_FILES = ("cameras.json", "transforms.json", "cameras.zip")
_TABLE = "text_table.safetensors"
_ENCODERS = {space: encoder for encoder, space in BUILT_IN.items()}
_PHRASES = 3  # asked when nobody says which


@dataclass(frozen=True)
class Truth:
    """What is really there."""

    names: tuple[str, ...]  # object names
    masks: Mapping[str, np.ndarray]  # view -> [H, W] integers, rows of names; -1 = none
    meant: Mapping[str, tuple[str, ...]]  # phrase, no article -> the objects that it means, none where nothing here
    asked: tuple[str, ...]  # phrases that the scene is to be asked

    def mask_of(self, phrase: str, view: str) -> np.ndarray | None:
        """[H, W] bool, where the phrase's objects are; None when the phrase or the view has no truth."""
        meant = self.meant.get(_bare(phrase))
        if meant is None or view not in self.masks:
            return None
        rows = [self.names.index(name) for name in meant]
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
    other_packs: tuple[str, ...]  # file names of packs beside it that were not taken
    encoder: str  # specification of the text encoder
    text_space: str  # of the features; "none" when no text encoder shares it, "" when the pack does not say
    phrases: tuple[str, ...]  # empty = nothing can be asked, or nobody knows what
    views: tuple[str, ...]  # to look from, the pictured one first; views with truth where there are any
    truth: Truth | None


def unpack_tabletop(folder: Path) -> Path:
    """Write the scene that ships as plain files: splats, cameras, a pack of 18 views, truth; the folder.

    It is 12 published splat objects on a table. No photo went through CLIP: a region's vector is the text vector of
    its word with noise, moved so far from all words as vectors of photos are (cosine .29 to its own word, .22 to
    others). Of the masks 30 % are merged with a neighbour, 15 % split, 10 % of another word. Sources and licences are
    in ``tabletop/LICENCES.md``; what made the files is ``tests/benchmarks/demo_scene.py``.
    """
    import zstandard

    folder.mkdir(parents=True, exist_ok=True)
    for file in SHIPPED.iterdir():
        content = file.read_bytes()
        if file.suffix == ".zst":
            (folder / file.stem).write_bytes(zstandard.ZstdDecompressor().decompress(content))
        else:
            (folder / file.name).write_bytes(content)
    return folder


def find_scene(folder: Path, phrases: Sequence[str], scratch: Path, pack: Path | None = None) -> DemoScene:
    """A scene folder as it is: the files are found by name, a COLMAP model is zipped for the upload.

    Args:
        folder: holds splats (``.ply``, ``.sog``, ``.spz`` or ``.splat``), cameras (``cameras.json``,
            ``transforms.json``, ``sparse/0``) and a pack.
        phrases: what to ask; empty = what ``truth.json`` says, else the three of its objects that fill most of the
            pictured view, and nothing where the features have no words.
        scratch: where to put the zipped model.
        pack: the feature pack; None takes ``features.safetensors``, else the first by name.

    Raises:
        InvalidInput: something is missing, or there are no words to ask the phrases with; the error says what.
    """
    if not folder.is_dir():
        raise InvalidInput("--scene", expected="a folder", got=f"nothing at {folder}")
    truth = _read_truth(folder)
    cameras = _cameras(folder, scratch)
    packs = _packs(folder)
    table, features = folder / _TABLE, pack or packs[0]
    text_space = read_features(features).text_space
    askable = table.is_file() or text_space in (*_ENCODERS, OWN_WORDS)
    if phrases and not askable:
        raise InvalidInput(
            "--ask", expected=f"words in the space of the features, as {_TABLE} in {folder.name}",
            got=f"none, and features whose text space is {text_space or 'not named'}",
            hint="leave --ask out, and it is asked by example" if text_space == NO_WORDS
            else "or use 'splatlift lift' and 'splatlift query --encoder', which take any text encoder",
        )  # fmt: skip
    return DemoScene(
        name=folder.name,
        splats=_splats(folder),
        cameras=cameras,
        features=features,
        other_packs=tuple(one.name for one in packs if not one.exists() or one.resolve() != features.resolve()),
        encoder=f"table:{table}" if table.is_file() else _ENCODERS.get(text_space, next(iter(BUILT_IN))),
        text_space=text_space,
        phrases=tuple(phrases) or (truth.asked if truth and askable and text_space != NO_WORDS else ()),
        views=tuple(truth.masks) if truth else _some_views(cameras),
        truth=truth,
    )


def _splats(folder: Path) -> Path:
    """The splats of a folder, or of the last iteration that a 3DGS trainer kept in it."""
    found = next((name for name in identify(folder).splats if name.lower().endswith(SPLATS_SENT)), None)
    if found is None:
        raise InvalidInput(f"splats of {folder.name}", expected=f"a file of {', '.join(SPLATS_SENT)}", got="none")
    return folder / found


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


def _packs(folder: Path) -> list[Path]:
    """The feature packs of a folder, ``features.safetensors`` first."""
    found = [path for path in visible_files(folder, "*.safetensors") if kind_of(path) == "features"]
    if not found:
        raise InvalidInput(f"features of {folder.name}", expected="a feature pack (.safetensors)", got="none")
    return sorted(found, key=lambda path: path.name != "features.safetensors")


def _read_truth(folder: Path) -> Truth | None:
    """``truth.json``: the objects, what to ask, what phrases mean; ``truth.safetensors``: ``VIEW/mask``."""
    from safetensors.numpy import load_file

    names_file, arrays_file = folder / "truth.json", folder / "truth.safetensors"
    if not (names_file.is_file() and arrays_file.is_file()):
        return None
    document = json.loads(names_file.read_text())
    arrays = load_file(arrays_file)
    names = tuple(str(thing["class"]) for thing in document["objects"])
    meant = {_bare(name): (name,) for name in names}
    masks = {key.removesuffix("/mask"): mask for key, mask in arrays.items() if key.endswith("/mask")}
    return Truth(
        names=names,
        masks={view: masks[view] for view in document.get("held_out_views", masks)},
        meant=meant | {_bare(phrase): tuple(things) for phrase, things in document.get("phrases", {}).items()},
        asked=tuple(document.get("ask", [f"the {name}" for name in _in_view(names, masks, document)])),
    )


def _bare(phrase: str) -> str:
    """A phrase without its article, in small letters."""
    return re.sub(r"^(an?|the)\s+", "", phrase.strip().casefold())


def _in_view(names: Sequence[str], masks: Mapping[str, np.ndarray], document: Mapping) -> list[str]:
    """The objects that fill most of the pictured view."""
    shown = next((masks[view] for view in document.get("held_out_views", masks) if view in masks), np.empty(0, int))
    counts = np.bincount(shown[(shown >= 0) & (shown < len(names))], minlength=len(names))
    return [names[int(row)] for row in np.argsort(-counts, kind="stable")[:_PHRASES] if counts[row]]


def _some_views(cameras: Path) -> tuple[str, ...]:
    from liftcore.io.cameras import read_cameras

    views = [camera.name for camera in read_cameras(cameras).values()]
    return (views[len(views) // 2],)
