"""Views of features by name: from feature packs, from values in memory or from an iterator, behind one protocol.

A feature pack is a ``.safetensors`` file of what 2D encoders saw: it can be mapped and holds no code. A view ``V``
is either regions, ``V/labels`` [L, h, w] (u8 with 255 for none, i16 or i32 with -1) with ``V/codebook`` [M, F], or
a grid, ``V/grid`` [h, w, F], all of the ``map_fit`` in the metadata (`liftcore.values.fit`). A pack may bring its
words: ``embeddings`` [n, F] and the metadata ``words``, as a table of text embeddings has them; a lift of it needs
no encoder for queries by these.
"""

import errno
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple, Protocol, cast

import torch
from torch import Tensor

from liftcore.errors import InvalidFeatures, InvalidTable, Unavailable, reading
from liftcore.io.files import whole_file
from liftcore.io.kinds import wrong_kind
from liftcore.io.safetensors_file import (
    MAX_HEADER_BYTES,
    check_arrays,
    check_header,
    safetensors_header,
    tensor_bytes,
)
from liftcore.runtime.arguments import as_path
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Progress, silent
from liftcore.runtime.torch_modes import callers_modes
from liftcore.scene.cameras import FEWER_VIEWS, MAX_VIEWS, Camera
from liftcore.scene.views import composed, require_name, require_pairs
from liftcore.text.table import TableEncoder
from liftcore.values.fit import Fit, Window, window_of
from liftcore.values.lens import as_pinhole_sees, grid_sides
from liftcore.values.views import MAX_CHANNELS, NO_LABEL, FeatureGrid, Regions, ViewFeatures

U8_NO_LABEL = 255
LARGEST_I16 = 32_767
FEATURE_TYPES = "f2 f4 bf16"
PARTS = {"labels": ("u1 i2 i4", "L h w"), "codebook": (FEATURE_TYPES, "M F"), "grid": (FEATURE_TYPES, "h w F")}
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
TABLE = "embeddings"
FIT = "map_fit"  # of the metadata: of the pack's grids
MAX_TENSORS = 2 * MAX_VIEWS + 1  # of a pack: labels and a codebook a view, and its words


class TensorSpec(NamedTuple):
    """Type and shape of a tensor of a pack, known before it is read."""

    dtype: str  # as safetensors names it: "F16"
    shape: tuple[int, ...]


Shapes = dict[str, tuple[int, ...]]  # of the tensors of a view: labels and codebook, or grid


class _Source(Protocol):
    """Source of one view."""

    @property
    def shapes(self) -> Shapes: ...
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
    _cameras: Mapping[str, Camera] = field(default_factory=dict, repr=False)
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
        camera = self.seeing(view)
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

    def shapes(self, view: str) -> Shapes:
        """Return the shapes of a view's tensors by part (labels and codebook, or grid), from the header alone."""
        shapes = self._find(view).shapes
        camera = self.seeing(view)
        if camera is not None and (window := self.window(view, camera)) is not None:
            sides = (part.stop - part.start for part in (window.rows, window.columns))
            return {"grid": (*sides, shapes["grid"][2])}
        if camera is None or camera.lens is None:
            return shapes
        if "grid" in shapes:
            height, width, channels = shapes["grid"]
            return {"grid": (*grid_sides(height, width, camera), channels)}
        return shapes | {"labels": (shapes["labels"][0], camera.height, camera.width)}

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

    def seeing(self, view: str) -> Camera | None:
        """Return the camera whose pinhole sees the view; None of views that are not paired."""
        return self._cameras.get(composed(view))

    def _find(self, view: str) -> _Source:
        source = self._sources.get(composed(view))
        if source is None:
            raise InvalidFeatures("view", expected="a view of the features", got=repr(view))
        return source


def as_views(views: Mapping[str, ViewFeatures] | Iterable[tuple[str, ViewFeatures]]) -> Views:
    """Convert any views for `lift`: `Views` as they are, a mapping's read lazily, an iterator's from the disk.

    An iterator is consumed once, a view at a time: each is written to a file that has no name any more once this
    returns, so a lift that reads views again never holds all of them.

    Args:
        views: `Views`, a mapping of names, which may read its values lazily, or pairs of a name and a value.
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
        _check_channels((name, source.read()) for name, source in sources.items())
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
    sources: dict[str, _Stored] = {}
    channels: dict[int, str] = {}
    for pack in packs:
        for view, stored in _composed_names(pack.views).items():
            if view in sources:
                raise ValueError(f"each view in one pack, got {view!r} in {sources[view].pack.path} and {pack.path}")
            sources[view] = source = _Stored(pack, stored)
            with reading(source.where, InvalidFeatures, "labels with a codebook, or a grid"):
                channels.setdefault(_check_specs(source.specs), source.where)
        if len(sources) > MAX_VIEWS:
            raise ValueError(f"at most {MAX_VIEWS} views, got {len(sources)} up to {pack.path}; {FEWER_VIEWS}")
    if not sources:
        raise ValueError(f"at least one view, got {len(packs)} packs without any")
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

    ``views`` may read its views lazily: each is read twice, once for its shape and once for
    its bytes, and not kept in between. Labels are stored as int16 where the codebook allows.

    Args:
        path: the file to write.
        views: view name -> what it observes.
        metadata: ``encoder``, ``text_space``, ``normalised`` ("true" or "false") and what else to
            keep.
        progress: called in the stages "check" and "pack", in views.
        table: words of the pack's own, of as many channels.
    """
    if not views:
        raise InvalidFeatures(str(path), expected="at least one view", got="none")
    for view in views:
        require_name(view, "the name of a view", InvalidFeatures)
    with whole_file(path) as handle:
        if table is None:
            return _write(handle, views, metadata, progress)
        extra_tensors = {TABLE: torch.from_numpy(table.embeddings).half()}
        _write(handle, views, {**metadata, "words": json.dumps(table.words)}, progress, extra_tensors)


def _write(
    handle: IO[bytes],
    views: Mapping[str, ViewFeatures],
    metadata: Mapping[str, str],
    progress: Progress,
    extra_tensors: Mapping[str, Tensor] = MappingProxyType({}),
) -> None:
    specs = [(name, value.dtype, tuple(value.shape)) for name, value in extra_tensors.items()]
    fits = set[str]()

    def iterate_reported() -> Iterator[tuple[str, ViewFeatures]]:
        for count, (view, features) in enumerate(views.items(), start=1):
            yield view, features
            fits.update([features.fit] if isinstance(features, FeatureGrid) else [])
            specs.extend((f"{view}/{part}", value.dtype, tuple(value.shape)) for part, value in _parts(features))
            progress("check", count, len(views), "views")

    _check_channels(iterate_reported())
    if len(fits) > 1:
        raise InvalidFeatures(
            "views", expected="one fit of all maps of a pack", got=", ".join(map(repr, sorted(fits)))
        )
    if fits - {""}:
        metadata = {**metadata, FIT: fits.pop()}
    header, offsets = safetensors_header(specs, metadata)
    if len(header) > MAX_HEADER_BYTES:
        raise InvalidFeatures("views", expected="fewer views in a pack", got=str(len(views)))
    handle.write(header)
    for name, tensor in extra_tensors.items():
        handle.seek(len(header) + offsets[name])
        handle.write(tensor_bytes(tensor))
    for count, (view, features) in enumerate(views.items(), start=1):
        for part, tensor in _parts(features):
            handle.seek(len(header) + offsets[f"{view}/{part}"])
            handle.write(tensor_bytes(tensor))
        progress("pack", count, len(views), "views")


def _parts(features: ViewFeatures) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a view as they are stored."""
    if isinstance(features, Regions):
        narrow = len(features.codebook) <= LARGEST_I16
        yield "labels", features.labels.to(torch.int16 if narrow else torch.int32)
        yield "codebook", features.codebook
    else:
        yield "grid", features.grid


def _check_channels(views: Iterable[tuple[str, ViewFeatures]]) -> None:
    channels: dict[int, str] = {}
    for view, features in views:
        channels.setdefault(features.codebook.shape[1], view)
    if len(channels) > 1:
        got = ", ".join(f"{count} in {view!r}" for count, view in list(channels.items())[:3])
        raise InvalidFeatures("features", expected="the same channels in every view", got=got)


def _spooled(pairs: Iterable[tuple[str, ViewFeatures]]) -> Views:
    with callers_modes():
        rest, end = iter(pairs), object()

    def next_pair() -> Any:
        with callers_modes():
            return next(rest, end)

    with scratch_folder("splatlift-views-") as folder:
        files: dict[str, Path] = {}
        for pair in iter(next_pair, end):
            if not (isinstance(pair, tuple | list) and len(pair) == 2):
                got = type(pair).__name__
                raise InvalidFeatures("features", expected="pairs of a name and a view", got=got)
            name, features = pair
            (name,) = _composed_names([name])
            if name in files:
                raise InvalidFeatures("features", expected="each view once", got=f"{name!r} twice")
            files[name] = folder / f"{len(files)}.safetensors"
            view = _MemoryView({name: features}, name).read()
            try:
                with files[name].open("wb") as handle:
                    _write(handle, {name: view}, {}, silent)
            except OSError as error:
                if error.errno not in NO_ROOM:
                    raise
                hint = "set TMPDIR to a folder with more room, or give a mapping of views, which is read as it is"
                expected, got = f"room for an iterator's views in {folder}", error.strerror or str(error)
                raise Unavailable("features", expected=expected, got=got, hint=hint) from error
        if not files:
            raise InvalidFeatures("features", expected="at least one view", got="none")
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
    def shapes(self) -> Shapes:
        return {part: tuple(tensor.shape) for part, tensor in _parts(self.read())}

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
class _PackFile:
    path: Path
    handle: Any  # an open safetensors mapping
    specs: dict[str, TensorSpec]
    metadata: dict[str, str]
    views: list[str]


@dataclass(frozen=True)
class _Stored:
    """A view of a pack."""

    pack: _PackFile
    name: str

    @property
    def where(self) -> str:
        return f"{self.pack.path} view {self.name!r}"

    @property
    def specs(self) -> dict[str, TensorSpec]:
        keys = {part: f"{self.name}/{part}" for part in PARTS}
        return {part: self.pack.specs[key] for part, key in keys.items() if key in self.pack.specs}

    @property
    def shapes(self) -> Shapes:
        return {part: spec.shape for part, spec in self.specs.items()}

    @property
    def fit(self) -> str:
        return self.pack.metadata.get(FIT, "") if "grid" in self.specs else ""

    def read(self) -> ViewFeatures:
        tensor = self.pack.handle.get_tensor
        if "grid" in self.specs:
            return FeatureGrid(tensor(f"{self.name}/grid"), fit=cast("Any", self.fit), context=self.where)
        stored = tensor(f"{self.name}/labels")
        labels = stored.to(torch.int32)
        if stored.dtype == torch.uint8:
            labels[stored == U8_NO_LABEL] = NO_LABEL
        return Regions(labels, tensor(f"{self.name}/codebook"), context=self.where)


def _open(path: Path) -> _PackFile:
    from safetensors import SafetensorError, safe_open

    expected, hint = "a feature pack (.safetensors)", "make packs with 'splatlift pack'"
    try:
        with reading(path, InvalidFeatures, expected, hint):
            check_header(path)
            try:
                handle: Any = safe_open(str(path), framework="pt")
                names = handle.keys()
                if len(names) > MAX_TENSORS:
                    limit = f"at most {MAX_VIEWS} views, of two tensors each"
                    raise ValueError(f"{limit}, got {len(names)} tensors; {FEWER_VIEWS}")
                slices = {name: handle.get_slice(name) for name in names}
                specs = {
                    name: TensorSpec(part.get_dtype(), _axes(name, part.get_shape())) for name, part in slices.items()
                }
                return _PackFile(path, handle, specs, handle.metadata() or {}, _view_names(names))
            except SafetensorError as error:
                raise ValueError(f"{expected}, got a file that does not open as one ({str(error)[:120]})") from None
    except InvalidFeatures as error:
        raise wrong_kind(path, "features", InvalidFeatures, expected=expected) or error from None


def _axes(name: str, shape: Sequence[int]) -> tuple[int, ...]:
    """Return the shape of a tensor of a pack with the axes of its part: others of length 1 before them go, and labels
    [h, w] are one level.
    """
    part = name.rpartition("/")[2]
    extra = len(shape) - len(PARTS[part][1].split()) if part in PARTS else 0
    if part == "labels" and extra == -1:
        return (1, *shape)
    return tuple(shape[extra:]) if extra > 0 and all(side == 1 for side in shape[:extra]) else tuple(shape)


def _view_names(tensors: Sequence[str]) -> list[str]:
    views: dict[str, None] = {}
    for key in tensors:
        view, _, part = key.rpartition("/")
        if key == TABLE and len(tensors) > 1:
            continue
        if not view or part not in PARTS:
            raise ValueError(f"tensors 'VIEW/labels' with 'VIEW/codebook', or 'VIEW/grid', got {key[:120]!r}")
        views[view] = None
    return list(views)


def _check_specs(specs: Mapping[str, TensorSpec]) -> int:
    """Check the header of one view; its channels."""
    if set(specs) not in ({"grid"}, {"labels", "codebook"}):
        raise ValueError(f"labels with a codebook, or a grid, got {' with '.join(specs)}")
    lengths = check_arrays(specs, PARTS)
    if not all(lengths.values()) or lengths["F"] > MAX_CHANNELS:
        got = " with ".join(f"{part} {list(spec.shape)}" for part, spec in specs.items())
        raise ValueError(f"no side empty, and at most {MAX_CHANNELS} channels, got {got}")
    return lengths["F"]


def _table(packs: Sequence[_PackFile], channels: int) -> TableEncoder | None:
    """Return the words that the packs bring, the same in all that bring some."""
    tables: dict[Path, TableEncoder] = {}
    for pack in packs:
        if TABLE not in pack.specs:
            continue
        argument = f"{pack.path} {TABLE}"
        rows = pack.handle.get_tensor(TABLE)
        rows = (rows.float() if rows.dtype == torch.bfloat16 else rows).numpy()
        try:
            table = TableEncoder.of(f"words of {pack.path.name}", pack.metadata.get("words", "null"), rows)
        except InvalidTable as error:
            raise InvalidFeatures(argument, expected=error.expected, got=error.got, hint=error.hint) from None
        if table.channels != channels:
            expected = f"{channels} channels, as its views have"
            raise InvalidFeatures(argument, expected=expected, got=str(table.channels))
        first = next(iter(tables), pack.path)
        tables[pack.path] = table
        if table.words != tables[first].words or (table.embeddings != tables[first].embeddings).any():
            hint = "write the masks of all views into one pack"
            raise ValueError(f"one table in all packs, got two in {first} and {pack.path}; {hint}")
    return next(iter(tables.values()), None)


def _shared_metadata(packs: Sequence[_PackFile], key: str) -> str:
    values = {pack.metadata.get(key, ""): pack.path for pack in packs}
    paths = {value: path for value, path in values.items() if value}
    if len(paths) > 1:
        got = " and ".join(f"{value[:80]!r} in {path}" for value, path in paths.items())
        raise ValueError(f"one {key} in all packs, got {got}; features of different spaces cannot make one lift")
    return next(iter(paths), "")
