"""Feature packs: what 2D encoders saw, view by view, in one file that can be mapped and holds no code.

A pack is a ``.safetensors`` file. A view ``V`` is either regions, ``V/labels`` [L, h, w] (u8 with 255 for
none, i16 or i32 with -1) with ``V/codebook`` [M, F], or a grid, ``V/grid`` [h, w, F].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch

from liftcore.errors import InvalidFeatures
from liftcore.features.finite import check_finite
from liftcore.features.header import check_header
from liftcore.features.through_lens import as_pinhole_sees, grid_sides
from liftcore.features.views import NO_LABEL, FeatureGrid, Regions, ViewFeatures
from liftcore.scene.view_pairs import require_pairs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from torch import Tensor

    from liftcore.scene.cameras import Camera, Cameras

MAX_CHANNELS = 1 << 16
U8_NO_LABEL = 255
LABEL_TYPES = ("U8", "I16", "I32")
FEATURE_TYPES = ("F16", "F32", "BF16")
PARTS = ("labels", "codebook", "grid")


@dataclass(frozen=True)
class TensorSpec:
    """What a header says of a tensor."""

    dtype: str  # safetensors' name: "F16"
    shape: tuple[int, ...]


@dataclass(frozen=True)
class _PackFile:
    path: Path
    handle: Any  # an open safetensors mapping
    specs: dict[str, TensorSpec]
    metadata: dict[str, str]


@dataclass(frozen=True)
class _Stored:
    """Where a view is: its pack, and its name in it."""

    pack: _PackFile
    name: str

    def has(self, part: str) -> bool:
        return f"{self.name}/{part}" in self.pack.specs

    def spec(self, part: str) -> TensorSpec:
        return self.pack.specs[f"{self.name}/{part}"]

    def where(self, part: str) -> str:
        return f"{self.pack.path} view {self.name!r} {part}"


@dataclass(frozen=True)
class FeaturePacks:
    """One or more packs that make one set of views. Headers are checked; tensors are read when asked for."""

    views: tuple[str, ...]  # sorted
    channels: int  # F
    encoder: str  # the 2D encoder as the packs tell it, "" when they do not
    text_space: str  # the text encoder that shares the space; "" unknown, "none" when there is none
    normalised: bool | None  # whether codebook rows and grid cells are unit vectors; None when not told
    paths: tuple[Path, ...]
    _stored: Mapping[str, _Stored]
    _cameras: Mapping[str, Camera] = field(default_factory=dict)  # of views that are seen as their pinholes see them

    def is_regions(self, view: str) -> bool:
        """Whether the view is a region map; else it is a grid."""
        return self._find(view).has("labels")

    def specs(self, view: str) -> dict[str, TensorSpec]:
        """The tensors of a view's observation by part (labels, codebook, grid), from the header alone."""
        stored = self._find(view)
        specs = {part: stored.spec(part) for part in PARTS if stored.has(part)}
        camera = self._cameras.get(view)
        if camera is None or camera.lens is None:
            return specs
        if "grid" in specs:
            height, width, channels = specs["grid"].shape
            return {"grid": replace(specs["grid"], shape=(*grid_sides(height, width, camera), channels))}
        levels = math.prod(specs["labels"].shape[:-2])
        labels = replace(specs["labels"], shape=(levels, camera.height, camera.width))
        return specs | {"labels": labels}

    def map_size(self, view: str) -> tuple[int, int]:
        """Width and height of a view's labels or grid as they lie in the file, from the header alone."""
        stored = self._find(view)
        height, width = stored.spec("labels").shape[-2:] if stored.has("labels") else stored.spec("grid").shape[:2]
        return width, height

    def observation(self, view: str) -> ViewFeatures:
        """Read and check one view; of packs that were paired with cameras as its pinhole sees it.

        Raises:
            InvalidFeatures: no such view, a label out of the codebook, or a feature that is not finite.
        """
        stored = self._find(view)
        if stored.has("labels"):
            codebook = _features(stored, "codebook")
            found = Regions(_labels(stored, rows=codebook.shape[0]), codebook)
        else:
            found = FeatureGrid(_features(stored, "grid"))
        return as_pinhole_sees(found, self._cameras[view]) if view in self._cameras else found

    def sample_rows(self, view: str, count: int) -> Tensor:
        """Some rows [n, F] of the view's codebook, ``count`` at most; nothing else of it is read or checked.

        The first rows of a codebook, or evenly spaced cells of a grid as it lies in the file.
        """
        part = "codebook" if self.is_regions(view) else "grid"
        found = self._find(view)
        stored = found.pack.handle.get_slice(f"{found.name}/{part}")
        if part == "codebook":
            return stored[:count]
        height, width = found.spec(part).shape[:2]
        lines = _spread(height, round(count**0.5))
        cells = _spread(width, count // len(lines))
        return torch.cat([stored[line][cells] for line in lines])

    def seen_by(self, names: Mapping[str, str], cameras: Mapping[str, Camera]) -> FeaturePacks:
        """The views that ``names`` gives the name of a camera, under it and as it sees them, and no others."""
        stored = {name: self._find(view) for view, name in names.items()}
        used = {name: cameras[name] for name in stored}
        return replace(self, views=tuple(sorted(stored)), _stored=stored, _cameras=used)

    def _find(self, view: str) -> _Stored:
        if view not in self._stored:
            raise InvalidFeatures("view", expected="a view of the feature packs", got=repr(view))
        return self._stored[view]


def open_packs(paths: Sequence[Path]) -> FeaturePacks:
    """Open packs as one; only headers are read.

    Raises:
        InvalidFeatures: a file is no feature pack, a view is malformed or in two packs, or the packs do not
            share their channels and their encoder.
    """
    files: dict[str, _PackFile] = {}
    channels: dict[int, str] = {}
    packs = [_open(path) for path in paths]
    for pack in packs:
        for view in _views(pack):
            if view in files:
                got = f"{view!r} in {files[view].path} and {pack.path}"
                raise InvalidFeatures("features", expected="each view in one pack", got=got)
            channels.setdefault(_check_view(pack, view), f"{pack.path} view {view!r}")
            files[view] = pack
    if not files:
        raise InvalidFeatures("features", expected="at least one view", got=f"{len(packs)} packs without any")
    if len(channels) > 1:
        (one, here), (other, there) = list(channels.items())[:2]
        got = f"{one} in {here} and {other} in {there}"
        raise InvalidFeatures("features", expected="the same channels in every view", got=got)
    normalised = _agreed(packs, "normalised").lower()
    return FeaturePacks(
        views=tuple(sorted(files)),
        channels=next(iter(channels)),
        encoder=_agreed(packs, "encoder"),
        text_space=_agreed(packs, "text_space"),
        normalised={"true": True, "false": False}.get(normalised),
        paths=tuple(paths),
        _stored={view: _Stored(pack, view) for view, pack in files.items()},
    )


def pair(packs: FeaturePacks, cameras: Cameras) -> tuple[FeaturePacks, list[str]]:
    """The views that have a camera, named like it, and the names of those that have none, to be skipped and told.

    Raises:
        InvalidFeatures: no view has a camera.
    """
    names = require_pairs(packs.views, cameras)
    return packs.seen_by(names, cameras), [view for view in packs.views if view not in names]


def _spread(length: int, count: int) -> list[int]:
    """At most ``count`` places of so many, evenly spaced and off the ends; one at least."""
    steps = max(1, min(count, length))
    return [(2 * k + 1) * length // (2 * steps) for k in range(steps)]


def _open(path: Path) -> _PackFile:
    from safetensors import SafetensorError, safe_open

    check_header(
        path, str(path), InvalidFeatures, expected="a feature pack (.safetensors)",
        hint="make packs with 'splatlift pack'",
    )  # fmt: skip
    try:
        handle: Any = safe_open(str(path), framework="pt")
        slices = {name: handle.get_slice(name) for name in tuple(handle.keys())}
        specs = {name: TensorSpec(part.get_dtype(), tuple(part.get_shape())) for name, part in slices.items()}
        return _PackFile(path, handle, specs, handle.metadata() or {})
    except (SafetensorError, OSError) as error:
        got = f"a file that does not open as one ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected="a feature pack (.safetensors)", got=got) from None


def _views(pack: _PackFile) -> list[str]:
    views: dict[str, None] = {}
    for key in pack.specs:
        view, _, part = key.rpartition("/")
        if not view or part not in PARTS:
            hint = "a table of text embeddings belongs to a query" if key == "embeddings" else ""
            expected = "tensors 'VIEW/labels' with 'VIEW/codebook', or 'VIEW/grid'"
            raise InvalidFeatures(str(pack.path), expected=expected, got=repr(key)[:120], hint=hint)
        views[view] = None
    return list(views)


def _check_view(pack: _PackFile, view: str) -> int:
    """Check the header of one view; its channels."""
    parts = {part: pack.specs[f"{view}/{part}"] for part in PARTS if f"{view}/{part}" in pack.specs}
    where = f"{pack.path} view {view!r}"
    if set(parts) not in ({"grid"}, {"labels", "codebook"}):
        raise InvalidFeatures(where, expected="labels with a codebook, or a grid", got=" with ".join(parts))
    if "grid" in parts:
        return _check_tensor(parts["grid"], FEATURE_TYPES, "h w F", f"{where} grid")[-1]
    labels = parts["labels"]
    _check_tensor(labels, LABEL_TYPES, "h w" if len(labels.shape) == 2 else "L h w", f"{where} labels")
    return _check_tensor(parts["codebook"], FEATURE_TYPES, "M F", f"{where} codebook")[-1]


def _check_tensor(spec: TensorSpec, types: tuple[str, ...], axes: str, where: str) -> tuple[int, ...]:
    fits = len(spec.shape) == len(axes.split()) and all(spec.shape) and spec.dtype in types
    if not fits or (axes.endswith("F") and spec.shape[-1] > MAX_CHANNELS):
        expected = f"{' or '.join(types)} [{axes.replace(' ', ', ')}], no side empty"
        raise InvalidFeatures(where, expected=expected, got=f"{spec.dtype} {list(spec.shape)}")
    return spec.shape


def _agreed(packs: Sequence[_PackFile], key: str) -> str:
    values = {pack.metadata.get(key, ""): pack.path for pack in packs}
    told = {value: path for value, path in values.items() if value}
    if len(told) > 1:
        got = " and ".join(f"{value[:80]!r} in {path}" for value, path in told.items())
        hint = "features of different spaces cannot make one lift"
        raise InvalidFeatures("features", expected=f"one {key} in all packs", got=got, hint=hint)
    return next(iter(told), "")


def _features(stored: _Stored, part: str) -> Tensor:
    """[.., F] f16 or f32, finite."""
    values: Tensor = stored.pack.handle.get_tensor(f"{stored.name}/{part}")
    values = values.float() if values.dtype == torch.bfloat16 else values
    check_finite(values, stored.where(part))
    return values


def _labels(stored: _Stored, rows: int) -> Tensor:
    """[L, h, w] i32 with -1 for none, all below ``rows``."""
    raw: Tensor = stored.pack.handle.get_tensor(f"{stored.name}/labels")
    labels = raw.to(torch.int32)
    if raw.dtype == torch.uint8:
        labels[raw == U8_NO_LABEL] = NO_LABEL
    low, high = (int(value) for value in torch.aminmax(labels))
    if low < NO_LABEL or high >= rows:
        raise InvalidFeatures(
            stored.where("labels"),
            expected=f"rows of its codebook (0..{rows - 1}) or {NO_LABEL} for none",
            got=f"the label {low if low < NO_LABEL else high}",
        )
    return labels if labels.ndim == 3 else labels[None]
