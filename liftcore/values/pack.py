"""Views of features by name: from feature packs, from values in memory or from an iterator, behind one protocol.

A feature pack is a ``.safetensors`` file of what 2D encoders saw: it can be mapped and holds no code. A view ``V``
is either regions, ``V/labels`` [L, h, w] (u8 with 255 for none, i16 or i32 with -1) with ``V/codebook`` [M, F], or
a grid, ``V/grid`` [h, w, F], all of the ``map_fit`` in the metadata (`liftcore.values.fit`). A pack may bring its
words: ``embeddings`` [n, F] and the metadata ``words``, as a table of text embeddings has them; a lift of it needs
no encoder for queries by these.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidFeatures, Unavailable, reading
from liftcore.io.files import whole_file
from liftcore.io.kinds import wrong_kind
from liftcore.io.npy import without_unit_axes
from liftcore.io.safetensors_file import (
    MAX_HEADER_BYTES,
    check_arrays,
    check_header,
    map_tensors,
    safetensors_header,
    tensor_bytes,
)
from liftcore.runtime.arguments import as_path, nearest
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Progress, silent
from liftcore.runtime.torch_modes import callers_modes
from liftcore.scene.cameras import Camera
from liftcore.scene.views import FEWER_VIEWS, MAX_VIEWS, composed, require_name, require_pairs
from liftcore.text.table import TableEncoder
from liftcore.values.fit import Fit, Window, window_of
from liftcore.values.lens import as_pinhole_sees, grid_sides
from liftcore.values.views import MAX_CHANNELS, NO_LABEL, FeatureGrid, Regions, ViewFeatures

U8_NO_LABEL = 255
LARGEST_I16 = 32_767
SCHEMA = {"labels": ("u1 i2 i4", "L h w"), "codebook": ("f2 f4 V2", "M F"), "grid": ("f2 f4 V2", "h w F")}
TABLE = "embeddings"
FIT = "map_fit"  # of the metadata: of the pack's grids
MAX_TENSORS = 2 * MAX_VIEWS + 1  # of a pack: labels and a codebook a view, and its words
EXPECTED = "a feature pack (.safetensors)"


class _Source(Protocol):
    """Source of one view."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]: ...  # by part: labels and codebook, or grid
    @property
    def fit(self) -> str: ...  # of a grid to its photo, "" for not recorded
    def read(self) -> ViewFeatures: ...


@dataclass(frozen=True, eq=False)
class Views(Mapping[str, ViewFeatures]):
    """View name -> `Regions` or `FeatureGrid`, names sorted; each view is read and checked at its access.

    Of packs, headers are checked at once. Reading a view raises InvalidFeatures where there is none of that name, a
    label is out of the codebook, or a feature is not finite. Paired with cameras (`pair`), a view is what the
    camera's pinhole sees.
    """

    channels: int  # F
    encoder: str  # name of the 2D encoder in the packs, "" if they have none
    text_space: str  # the text encoder that shares the space; "" unknown, "none" when there is none
    normalised: bool | None  # True if codebook rows and grid cells are unit vectors; None: unknown
    _sources: Mapping[str, _Source] = field(repr=False)
    table: TableEncoder | None = None  # the packs' own words
    paths: tuple[Path, ...] = ()  # of the packs that it reads; () where views come from elsewhere
    _cameras: Mapping[str, Camera] = field(default_factory=dict, repr=False)  # of paired views
    _fit: str = ""  # of all grids, in place of those that are recorded

    @property
    def views(self) -> tuple[str, ...]:
        """The names, sorted."""
        return tuple(sorted(self._sources))

    def __iter__(self) -> Iterator[str]:
        return iter(self.views)

    def __len__(self) -> int:
        return len(self._sources)

    def __contains__(self, view: object) -> bool:
        return view in self._sources

    def __getitem__(self, view: str) -> ViewFeatures:
        features = self._find(view).read()
        if features.codebook.shape[1] != self.channels:
            got = f"{features.codebook.shape[1]} in {view!r}"
            raise InvalidFeatures("features", expected=f"{self.channels} channels in every view", got=got)
        camera = self._cameras.get(composed(view))
        if camera is None:
            return features
        window = self.window(view, camera)
        if window is not None and isinstance(features, FeatureGrid):
            return FeatureGrid.unchecked(features.grid[window.rows, window.columns].contiguous(), features.fit)
        return as_pinhole_sees(features, camera)

    def window(self, view: str, camera: Camera) -> Window | None:
        """Return what a map that was padded or cropped shows of its camera's photo; None of any other view."""
        fit = self.fit(view)
        return window_of(fit, self.map_size(view), camera.photo_size) if fit else None

    def is_regions(self, view: str) -> bool:
        """Return True if the view is a region map; else it is a grid."""
        return "labels" in self._find(view).shapes

    def shapes(self, view: str) -> dict[str, tuple[int, ...]]:
        """Return the shapes of a view by part (labels and codebook, or grid), from the header alone."""
        shapes = dict(self._find(view).shapes)
        camera = self._cameras.get(composed(view))
        if camera is None:
            return shapes
        if "labels" in shapes:
            sides = shapes["labels"][1:] if camera.lens is None else (camera.height, camera.width)
            return shapes | {"labels": (shapes["labels"][0], *sides)}
        height, width, channels = shapes["grid"]
        if (window := self.window(view, camera)) is not None:
            return {"grid": (*(part.stop - part.start for part in (window.rows, window.columns)), channels)}
        return {"grid": (*grid_sides(height, width, camera), channels)}

    def fit(self, view: str) -> str:
        """Return the fit of a view's map to its photo; "" where it is not recorded, as of region maps."""
        return self._fit if self._fit and not self.is_regions(view) else self._find(view).fit

    def with_fit(self, fit: Fit) -> "Views":
        """Return the same with another fit of all grids."""
        return replace(self, _fit=fit)

    def map_size(self, view: str) -> tuple[int, int]:
        """Width and height of a view's labels or grid as they are stored, from the header alone."""
        shapes = self._find(view).shapes
        height, width = shapes["labels"][1:] if "labels" in shapes else shapes["grid"][:2]
        return width, height

    def seen_by(self, views: Mapping[str, str], cameras: Mapping[str, Camera]) -> "Views":
        """Return only the views that ``views`` names for cameras, each as its camera sees it, under its name."""
        sources = {name: self._find(view) for name, view in views.items()}
        seeing = {name: self._cameras.get(view, cameras[name]) for name, view in views.items()}
        return replace(self, _sources=sources, _cameras=seeing)

    def only(self, views: Iterable[str]) -> "Views":
        """These of the views, as they are."""
        return replace(self, _sources={view: self._find(view) for view in views})

    def _find(self, view: str) -> _Source:
        source = self._sources.get(composed(view))
        if source is None:
            hint = nearest(str(view), self.views, 3)
            raise InvalidFeatures("view", expected="a view of the features", got=repr(view), hint=hint)
        return source


def as_views(views: Mapping[str, ViewFeatures] | Iterable[tuple[str, ViewFeatures]]) -> Views:
    """Convert any views for `lift`: `Views` as they are, a mapping's read lazily, an iterator's from the disk.

    An iterator is consumed once, a view at a time: each is written to a file that has no name any more once this
    returns, so a lift that reads views again never holds all of them.
    """
    if isinstance(views, Views):
        return views
    if isinstance(views, str | Path) or not isinstance(views, Iterable):
        got, hint = f"{type(views).__name__} {views!r}"[:80], "read_features(path) opens a feature pack"
        raise InvalidFeatures("features", expected="views by name, or pairs of a name and a view", got=got, hint=hint)
    if not isinstance(views, Mapping):
        return _spooled(views)
    mapping = cast("Mapping[str, ViewFeatures]", views)
    sources = {name: _MemoryView(mapping, key) for name, key in _composed_names(mapping).items()}
    if not sources:
        raise InvalidFeatures("features", expected="at least one view", got="none")
    if isinstance(views, dict):  # other mappings may read files: theirs are checked one by one
        _check_channels({source.read().codebook.shape[1]: name for name, source in sources.items()})
    channels = next(iter(sources.values())).read().codebook.shape[1]
    return Views(channels, "", "", None, sources)


@reading("features", InvalidFeatures, "feature packs")
def read_features(*paths: str | Path) -> Views:
    """Open feature packs as one set of views; only headers are read.

    Raises:
        InvalidFeatures: a file is no feature pack, a view is malformed or in two packs, or the packs do not
            share their channels and their encoder.
    """
    packs = [_open(as_path(path)) for path in paths]
    sources: dict[str, _PackView] = {}
    channels: dict[int, str] = {}
    for pack in packs:
        for view, stored in _composed_names(pack.views).items():
            source = pack.views[stored]
            if view in sources:
                raise ValueError(f"each view in one pack, got {view!r} in {sources[view].path} and {pack.path}")
            sources[view] = source
            channels.setdefault(source.channels(), source.where)
        if len(sources) > MAX_VIEWS:
            raise ValueError(f"at most {MAX_VIEWS} views, got {len(sources)} up to {pack.path}; {FEWER_VIEWS}")
    if not sources:
        raise ValueError("at least one view, got no pack")
    if len(channels) > 1:
        got = " and ".join(f"{count} in {place}" for count, place in list(channels.items())[:2])
        raise ValueError(f"the same channels in every view, got {got}")
    normalised = {"true": True, "false": False}.get(_shared_metadata(packs, "normalised").lower())
    encoder, text_space = _shared_metadata(packs, "encoder"), _shared_metadata(packs, "text_space")
    table = _table(packs, next(iter(channels)))
    arguments = (encoder, text_space, normalised, sources, table, tuple(pack.path for pack in packs))
    return Views(next(iter(channels)), *arguments)


def pair(views: Views, cameras: Mapping[str, Camera]) -> tuple[Views, list[str]]:
    """Return the views that have a camera, named like it, and the names of views without one."""
    names = require_pairs(views.views, cameras)
    by_camera = {name: view for view, name in names.items()}
    return views.seen_by(by_camera, cameras), [view for view in views if view not in names]


def write_pack(
    path: Path,
    views: Mapping[str, ViewFeatures],
    metadata: Mapping[str, str],
    progress: Progress = silent,
    table: TableEncoder | None = None,
) -> None:
    """Write views as a feature pack, whole or not at all.

    ``views`` may read its views lazily: each is read twice, for its shape and for its bytes, and not kept in between.
    Labels are stored as int16 where the codebook allows.

    Args:
        metadata: ``encoder``, ``text_space``, ``normalised`` ("true" or "false") and what else to keep.
        table: words of the pack's own, of as many channels.
    """
    if not views:
        raise InvalidFeatures(str(path), expected="at least one view", got="none")
    for view in views:
        require_name(view, "the name of a view", InvalidFeatures)
    with whole_file(path) as handle:
        _write(handle, views, metadata, progress, table)


def _write(
    handle: IO[bytes],
    views: Mapping[str, ViewFeatures],
    metadata: Mapping[str, str],
    progress: Progress = silent,
    table: TableEncoder | None = None,
) -> None:
    words = {} if table is None else {TABLE: torch.from_numpy(table.embeddings).half()}
    specs = [(name, tensor.dtype, tuple(tensor.shape)) for name, tensor in words.items()]
    channels, fits = dict[int, str](), set[str]()
    for count, (view, features) in enumerate(views.items(), start=1):
        channels.setdefault(features.codebook.shape[1], view)
        fits.update([features.fit] if isinstance(features, FeatureGrid) else [])
        specs += [(f"{view}/{part}", tensor.dtype, tuple(tensor.shape)) for part, tensor in _parts(features)]
        progress("check", count, len(views), "views")
    _check_channels(channels)
    if len(fits) > 1:
        got, hint = ", ".join(map(repr, sorted(fits))), "write the maps of each fit as a pack of their own"
        raise InvalidFeatures("views", expected="one fit of all maps of a pack", got=got, hint=hint)
    if table is not None:
        metadata = {**metadata, "words": json.dumps(table.words)}
    if fits - {""}:
        metadata = {**metadata, FIT: fits.pop()}
    header, offsets = safetensors_header(specs, metadata)
    if len(header) > MAX_HEADER_BYTES:
        hint = "write several packs: a lift reads them as one"
        raise InvalidFeatures("views", expected="fewer views in a pack", got=str(len(views)), hint=hint)
    handle.write(header)

    def write(name: str, tensor: Tensor) -> None:
        handle.seek(len(header) + offsets[name])
        handle.write(tensor_bytes(tensor))

    for name, tensor in words.items():
        write(name, tensor)
    for count, (view, features) in enumerate(views.items(), start=1):
        for part, tensor in _parts(features):
            write(f"{view}/{part}", tensor)
        progress("pack", count, len(views), "views")


def _parts(features: ViewFeatures) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a view as they are stored."""
    if isinstance(features, Regions):
        narrow = len(features.codebook) <= LARGEST_I16
        yield "labels", features.labels.to(torch.int16 if narrow else torch.int32)
        yield "codebook", features.codebook
    else:
        yield "grid", features.grid


def _check_channels(channels: Mapping[int, str]) -> None:
    """Refuse several numbers of channels, each with the name of a view that has it."""
    if len(channels) > 1:
        got = ", ".join(f"{count} in {view!r}" for count, view in list(channels.items())[:3])
        hint = "lift the views of each encoder by themselves"
        raise InvalidFeatures("features", expected="the same channels in every view", got=got, hint=hint)


def _spooled(pairs: Iterable[tuple[str, ViewFeatures]]) -> Views:
    with callers_modes():
        rest, end = iter(pairs), object()

    def next_pair() -> Any:
        with callers_modes():
            return next(rest, end)

    with scratch_folder("splatlift-views-") as folder:
        files: dict[str, Path] = {}
        for pair in iter(next_pair, end):
            with reading("features", InvalidFeatures, "pairs of a name and a view"):
                name, features = pair
                (name,) = _composed_names([name])
                if name in files:
                    raise ValueError(f"each view once, got {name!r} twice")
            view = _MemoryView({name: features}, name).read()
            files[name] = folder / f"{len(files)}.safetensors"
            try:
                with files[name].open("wb") as handle:
                    _write(handle, {name: view}, {})
            except OSError as error:
                hint = "set TMPDIR to a folder with more room, or give a mapping of views, which is read as it is"
                expected, got = f"room for an iterator's views in {folder}", error.strerror or str(error)
                raise Unavailable("features", expected=expected, got=got, hint=hint) from error
        if not files:
            raise InvalidFeatures("features", expected="at least one view", got="an iterator of none")
        return replace(read_features(*files.values()), paths=())  # mapped: the files may lose their names


def _composed_names(names: Iterable[Any]) -> dict[str, str]:
    """Return the original names by composed ones (NFC)."""
    originals: dict[str, str] = {}
    for name in names:
        if not isinstance(name, str):
            expected, got = "names that are texts, as of cameras", f"{type(name).__name__} {name!r}"[:80]
            raise InvalidFeatures("features", expected=expected, got=got)
        if originals.setdefault(composed(name), name) != name:
            got = f"{name!a} and {originals[composed(name)]!a}, which are one name in other forms of Unicode"
            raise InvalidFeatures("features", expected="each view once", got=got[:200])
    return originals


@dataclass(frozen=True)
class _MemoryView:
    """A view of a mapping of values."""

    views: Mapping[str, ViewFeatures]
    name: str

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        features = self.read()
        if isinstance(features, FeatureGrid):
            return {"grid": tuple(features.grid.shape)}
        return {"labels": tuple(features.labels.shape), "codebook": tuple(features.codebook.shape)}

    @property
    def fit(self) -> str:
        features = self.read()
        return features.fit if isinstance(features, FeatureGrid) else ""

    def read(self) -> ViewFeatures:
        with callers_modes():
            features = self.views[self.name]
        if isinstance(features, Regions | FeatureGrid):
            return features.cpu()
        hint = "make FeatureGrid(map [h, w, F]) or Regions(labels [L, h, w], codebook [M, F]) of arrays"
        raise InvalidFeatures(
            f"view {self.name!r}", expected="Regions or FeatureGrid", got=type(features).__name__, hint=hint
        )


@dataclass(frozen=True)
class _PackView:
    """A view of a pack."""

    path: Path  # of the pack
    name: str  # in the pack
    fit: str
    parts: dict[str, np.ndarray] = field(default_factory=dict)  # mapped

    @property
    def where(self) -> str:
        return f"{self.path} view {self.name!r}"

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return {part: array.shape for part, array in self.parts.items()}

    def channels(self) -> int:
        """Check types and shapes, and return F."""
        with reading(self.where, InvalidFeatures, "labels with a codebook, or a grid"):
            if set(self.parts) not in ({"grid"}, {"labels", "codebook"}):
                raise ValueError(f"labels with a codebook, or a grid, got {' with '.join(self.parts)}")
            sides = check_arrays(self.parts, SCHEMA)
            if not all(sides.values()) or sides["F"] > MAX_CHANNELS:
                raise ValueError(f"at most {MAX_CHANNELS} channels, and no side empty, got {self.shapes}")
            return sides["F"]

    def read(self) -> ViewFeatures:
        if "grid" in self.parts:
            return FeatureGrid(_tensor(self.parts["grid"]), fit=cast("Any", self.fit), context=self.where)
        stored = self.parts["labels"]
        labels = stored.astype(np.int32)
        if stored.dtype == np.uint8:
            labels[stored == U8_NO_LABEL] = NO_LABEL
        return Regions(labels, _tensor(self.parts["codebook"]), context=self.where)


def _tensor(array: np.ndarray) -> Tensor:
    """Return mapped floats as a tensor; NumPy has no bfloat16, and reads two bytes a number."""
    if array.dtype == np.dtype("V2"):
        return torch.from_numpy(array.view(np.int16)).view(torch.bfloat16)
    return torch.from_numpy(array)


@dataclass(frozen=True)
class _Pack:
    path: Path
    views: Mapping[str, _PackView]
    metadata: Mapping[str, str]
    embeddings: np.ndarray | None  # of its own words


def _open(path: Path) -> _Pack:
    try:
        with reading(path, InvalidFeatures, EXPECTED, "make packs with 'splatlift pack'"):
            check_header(path)
            arrays, metadata = map_tensors(path)
            if len(arrays) > MAX_TENSORS:
                limit = f"at most {MAX_VIEWS} views, of two tensors each"
                raise ValueError(f"{limit}, got {len(arrays)} tensors; {FEWER_VIEWS}")
            embeddings, views = arrays.pop(TABLE, None), dict[str, _PackView]()
            for key, array in arrays.items():
                name, _, part = key.rpartition("/")
                if not name or part not in SCHEMA:
                    raise ValueError(f"tensors 'VIEW/labels' with 'VIEW/codebook', or 'VIEW/grid', got {key[:120]!r}")
                view = views.setdefault(name, _PackView(path, name, metadata.get(FIT, "")))
                values = without_unit_axes(array, len(SCHEMA[part][1].split()))
                view.parts[part] = values[None] if part == "labels" and values.ndim == 2 else values
            if not views:
                raise ValueError(f"{EXPECTED}, got one without views")
    except InvalidFeatures as error:
        raise wrong_kind(path, "features", InvalidFeatures, expected=EXPECTED) or error from None
    return _Pack(path, views, metadata, embeddings)


def _table(packs: Sequence[_Pack], channels: int) -> TableEncoder | None:
    """Return the words that the packs bring, the same in all that bring some."""
    tables: dict[Path, TableEncoder] = {}
    for pack in packs:
        if pack.embeddings is None:
            continue
        name = f"words of {pack.path.name}"
        tables[pack.path] = table = TableEncoder.of(name, pack.metadata.get("words", "null"), pack.embeddings)
        first = next(iter(tables))
        if table.channels != channels:
            raise ValueError(f"words of {channels} channels, as its views, got {table.channels} in {pack.path}")
        if table.words != tables[first].words or (table.embeddings != tables[first].embeddings).any():
            hint = "write the masks of all views into one pack"
            raise ValueError(f"one table in all packs, got two in {first} and {pack.path}; {hint}")
    return next(iter(tables.values()), None)


def _shared_metadata(packs: Sequence[_Pack], key: str) -> str:
    values = {pack.metadata.get(key, ""): pack.path for pack in packs}
    paths = {value: path for value, path in values.items() if value}
    if len(paths) > 1:
        got = " and ".join(f"{value[:80]!r} in {path}" for value, path in paths.items())
        raise ValueError(f"one {key} in all packs, got {got}; features of different spaces cannot make one lift")
    return next(iter(paths), "")
