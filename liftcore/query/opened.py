"""An opened lift: arrays that queries share, with the splats, cameras and packs of its scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, Literal, Self
from weakref import finalize

import numpy as np

from liftcore.errors import InvalidLift, InvalidQuery, NotFound
from liftcore.io.splats import quick_count
from liftcore.query.scores import Features
from liftcore.scene.kernel import Kernel
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text.table import TableEncoder, own_words
from liftcore.values.lift_file import read_lift, tensors_of

if TYPE_CHECKING:  # these load torch
    from torch import Tensor

    from liftcore.query.question import Box
    from liftcore.query.terms import SplatSet
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Camera, Cameras
    from liftcore.scene.compositing import CompositingParams
    from liftcore.scene.splats import Splats
    from liftcore.text import TextEncoder
    from liftcore.values.lift import InputFile, Lift, LiftMetadata
    from liftcore.values.pack import Views

MOST_SAMPLED = 1 << 14  # splats of which a rough mean is computed
MOST_OF_OBJECT = 512  # splats of an object, likewise
TRANSFER = (
    "edited splats need a lift of their own, which 'splatlift transfer LIFT EDITED --splats LIFTED -o NEW' makes of "
    "this one (in Python lift.transferred)"
)
MOST_PIXELS = 1 << 26  # of a picture: 67 million take a minute of one core and 2 GB


class OpenedLift:
    """A lift with the splats and cameras of its scene: the state of `liftcore.query.scene.Scene`.

    Arguments and errors are those of `Scene`. Norms, mean, axes and encoders are computed once and cached.
    """

    features: Features
    """[P, F], exact or as codes; zero rows without a feature"""
    row_counts: np.ndarray | None = None
    """[P] f64, the number of splats that each row is of, of `distinct` rows; None: one"""
    # The tensors of `liftcore.values.lift.Lift`, as arrays.
    total_weight: np.ndarray
    cluster: np.ndarray | None
    cluster_features: np.ndarray | None
    confidence: np.ndarray | None
    object: np.ndarray | None
    object_views: np.ndarray | None
    node: np.ndarray | None
    node_parents: np.ndarray | None
    node_views: np.ndarray | None
    node_confidence: np.ndarray | None
    node_features: np.ndarray | None
    _metadata_json: str  # of a lift file
    _new_paths: dict[str, Path | None]  # of files that were moved, by their roles

    def __init__(
        self,
        source: Lift | Path | str,
        splats: Splats | Path | str | None = None,
        cameras: Mapping[str, Camera] | Path | str | None = None,
        packs: Views | None = None,
        *,
        world: WorldFrame = UNKNOWN,
    ) -> None:
        self._world_override = world
        self.labelled: tuple[Any, Any] | None = None  # the last exported source and its `Labels`, for the next file
        self.selections: dict[str, Any] = {}  # of `liftcore.query.selections` by their names
        self.node_boxes: dict[tuple[int, int], Box] = {}  # of listed nodes, by their ids and numbers of splats
        self.object_features: np.ndarray | None = None  # [N, F], of `liftcore.query.catalogue.object_features`
        self._encoders: dict[str | None, TextEncoder] = {}
        paths = {"splats": splats, "cameras": cameras}
        self._new_paths = {role: Path(at) if isinstance(at, str | Path) else None for role, at in paths.items()}
        if isinstance(source, str | Path):
            self.path = Path(source)
            arrays, self._metadata_json = read_lift(self.path)
            splats_path = self._new_paths["splats"]
            cached: dict[str, Any] = {}
        else:
            arrays = {name: as_numpy(tensor) for name, tensor in tensors_of(source).items()}
            self.path, splats_path = Path("lift"), None
            cached = {"lift": source, "metadata": self._with_places(source.metadata)}
        self._set_arrays(arrays)
        if splats_path is not None and splats_path.exists():
            self._require_rows(quick_count(splats_path))
        cached |= {"cameras": cameras} if cameras is not None and self._new_paths["cameras"] is None else {}
        cached |= {"packs": packs} if packs is not None else {}
        self.__dict__.update(cached)
        if splats is not None and not isinstance(splats, str | Path):
            self.lift.require_splats(splats)
            self.__dict__["splats"] = splats.cpu()

    def _set_arrays(self, arrays: dict[str, Any]) -> None:
        features, code = arrays["features"], arrays.get("code")
        self.features = Features(features if code is None else features.astype(np.float32), code)
        self.total_weight, self._has_feature = arrays["total_weight"], arrays["has_feature"]
        self.cluster, self.cluster_features = arrays.get("cluster"), arrays.get("cluster_features")
        self.confidence = arrays.get("confidence")
        self._embeddings = arrays.get("embeddings")
        self.object, self.object_views = arrays.get("object"), arrays.get("object_views")
        self.node, self.node_parents = arrays.get("node"), arrays.get("node_parents")
        self.node_views, self.node_confidence = arrays.get("node_views"), arrays.get("node_confidence")
        self.node_features = arrays.get("node_features")

    def encoder(
        self,
        encoder: TextEncoder | str | Path | None = None,
        *,
        hint: str = "give encoder=, or vectors",
        stand_in: bool = True,
    ) -> TextEncoder:
        """Open the encoder of a specification once, with a cache of its last texts; return an encoder as it is.

        None: the lift's own words, else the encoder of its text space.

        Args:
            hint: of the error if there is none. stand_in: if the weights of the space's encoder are not available,
                take its shipped table, which has its own words alone.

        Raises:
            InvalidQuery: it is something else, or the lift's text space names none.
            Unavailable: its weights are not on this machine.
        """
        from liftcore.text import CachingEncoder, encoder_of_space, open_encoder

        if encoder is not None and not isinstance(encoder, str | Path):
            if not all(hasattr(encoder, name) for name in ("encode", "channels", "name")):
                expected = "a text encoder (open_encoder) or its specification"
                raise InvalidQuery("encoder", expected=expected, got=type(encoder).__name__)
            return encoder
        if encoder is None and self.table is not None:
            return self.table
        key = None if encoder is None else str(encoder)
        if key not in self._encoders:
            space = self.metadata.text_space
            text_encoder = encoder_of_space(space, hint, stand_in=stand_in) if key is None else open_encoder(key)
            self._encoders[key] = CachingEncoder(text_encoder)
        return self._encoders[key]

    @cached_property
    def metadata(self) -> LiftMetadata:
        """The lift's metadata with the present paths of its files; parsed at the first access.

        Raises:
            InvalidLift: the file has no valid lift metadata, or its rows are not those of the splats that they name.
        """
        from liftcore.values.lift_file import input_file, parse_metadata

        metadata = parse_metadata(self._metadata_json, self.path)
        splats = Path(metadata.splats.path)
        if metadata.splats.path and self._new_paths["splats"] is None and splats.exists():
            count = quick_count(splats)
            # Another file may have this path now, whose number of rows does not matter.
            if count not in (None, len(self.features)) and input_file(splats).sha256 == metadata.splats.sha256:
                self._require_rows(count)
        return self._with_places(metadata)

    def _with_places(self, metadata: LiftMetadata) -> LiftMetadata:
        """Return the metadata with the new paths of files that were moved."""
        files = {
            name: getattr(metadata, name).model_copy(update={"path": str(place)})
            for name, place in self._new_paths.items()
            if place is not None
        }
        return metadata.model_copy(update=files) if files else metadata

    @cached_property
    def world(self) -> WorldFrame:
        """Up axis and length unit, as passed to the scene, else as stored in the lift; may be set."""
        return self._world_override.known_or(self.metadata.world)

    @cached_property
    def table(self) -> TableEncoder | None:
        """The words of its packs, as an encoder; None without any.

        Raises:
            InvalidTable: its words and their vectors do not fit together.
        """
        return own_words(self.metadata.words, self._embeddings)

    @cached_property
    def lift(self) -> Lift:
        """The lift with torch tensors over the same memory."""
        from liftcore.values.lift_file import open_lift

        return open_lift(self.path)

    @property
    def channels(self) -> int:
        """F."""
        return self.features.rows.shape[1]

    @cached_property
    def norms(self) -> np.ndarray:
        """[P] f32, the features' norms."""
        return self.features.of_splats(self.features.norms)

    @cached_property
    def has_feature(self) -> np.ndarray:
        """[P] bool, True if a splat has a feature."""
        return self._has_feature & (self.norms > 0)

    @cached_property
    def all_have_features(self) -> bool:
        """True if every splat has a feature."""
        return bool(self.has_feature.all())

    @cached_property
    def weights(self) -> np.ndarray | None:
        """[n] f32, total weights of the splats with a feature; None, which means equal ones, if all are zero."""
        weights = self.total_weight if self.all_have_features else self.total_weight[self.has_feature]
        return weights if weights.max(initial=0.0) > 0 else None

    @cached_property
    def effective_count(self) -> float:
        """Number of splats with a feature whose scores have as much noise as those of these total weights."""
        count, weights = np.count_nonzero(self.has_feature), self.weights
        return float(count if weights is None else weights.sum() ** 2 / max(float(np.square(weights).sum()), 1e-30))

    @cached_property
    def mean(self) -> np.ndarray:
        """[F] f32, the mean of the unit features by total weight, which all features of the scene share."""
        return self.features.mean(self.total_weight)

    @cached_property
    def rough_mean(self) -> np.ndarray:
        """[F] f32, the mean of at most MOST_SAMPLED evenly spaced ones: faster, and accurate enough for words."""
        rows = slice(None, None, -(-len(self.features) // MOST_SAMPLED) or 1)
        return self.features.mean(self.total_weight[rows], rows)

    @cached_property
    def distinct(self) -> Self:
        """The lift with a splat for each row of the features, of the row's total weight; itself if they are exact."""
        if self.features.code is None:
            return self
        rows = copy(self)
        for name in ("has_feature", "all_have_features", "weights", "norms"):
            rows.__dict__.pop(name, None)
        rows.__dict__ |= {"mean": self.mean, "rough_mean": self.rough_mean, "effective_count": self.effective_count}
        rows.features = Features(self.features.rows)
        rows.features.__dict__["norms"] = self.features.norms
        rows.row_counts = self.features.of_rows(self.has_feature)
        rows._has_feature = rows.row_counts > 0
        weights = self.features.of_rows(np.where(self.has_feature, self.total_weight, np.float32(0.0)))
        rows.total_weight = weights if weights.any() else rows.row_counts
        rows.object = rows.node = None  # of splats
        return rows

    @cached_property
    def object_means(self) -> np.ndarray:
        """[N, F] f32, the unit mean of the features of each object of the lift (`mean_of`)."""
        assert self.object is not None and self.object_views is not None
        objects = np.where(self.has_feature, self.object, -1)
        order = np.argsort(objects, kind="stable")
        ends = np.searchsorted(objects[order], np.arange(len(self.object_views) + 1))
        means = [self.mean_of(order[first:last]) for first, last in pairwise(ends.tolist())]
        return np.stack(means) if means else np.zeros((0, self.channels), np.float32)

    @cached_property
    def object_numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """The object of each splat with a feature, [P] i32, -1 for none; and the total weight of each, [N] f64."""
        assert self.object is not None and self.object_views is not None
        numbers = np.where(self.has_feature, self.object, -1)
        in_object = numbers >= 0
        return numbers, np.bincount(numbers[in_object], self.total_weight[in_object], len(self.object_views))

    def node_path(self, node: int) -> tuple[int, ...]:
        """Return the nodes of the tree that contain a node, the largest first, and the node itself."""
        assert self.node_parents is not None
        path = [node]
        while (above := int(self.node_parents[path[-1]])) >= 0:
            path.append(above)
        return tuple(reversed(path))

    def node_kind(self, node: int) -> Literal["object", "part", "group"]:
        """Return the kind of a node of the tree: the first nodes are the objects."""
        objects = 0 if self.object_views is None else len(self.object_views)
        if node < objects:
            return "object"
        return "part" if min(self.node_path(node)) < objects else "group"

    def lack_of_objects(self) -> str:
        """Explain why the lift has no objects, and how to get some."""
        settings = self.metadata.settings
        if settings.objects is False:
            cause = "quality=draft sets it" if settings.quality == "draft" else "they were not requested"
            return f"this lift has no objects, as objects=false ({cause}): lift again with objects=auto"
        return (
            "this lift has no objects: they are found by lifts of masks, by the preset default or the setting "
            "objects; grids have no masks"
        )

    def members(self, number: int) -> np.ndarray:
        """Return the splats of an object, or of another node of the tree with its parts, [P] bool.

        Raises:
            NotFound: the lift has no such object.
        """
        count = 0 if self.object_views is None else len(self.object_views)
        nodes = count if self.node_parents is None else len(self.node_parents)
        if self.object is None or not 0 <= number < nodes:
            expected = f"a number from 0 to {nodes - 1}" if nodes else "a lift with objects"
            hint = "the list of the lift's objects has them" if nodes else self.lack_of_objects()
            raise NotFound("object", expected=expected, got=str(number), hint=hint)
        if self.node is None or self.node_parents is None:
            return self.object == number
        below, above = np.zeros(nodes + 1, np.bool_), np.arange(nodes)
        while (above >= 0).any():
            below[:-1] |= above == number
            above = np.where(above >= 0, self.node_parents[above], -1)
        return below[self.node]  # the last entry is of splats without a node

    def set_members(self, splat_set: SplatSet) -> np.ndarray:
        """Return the splats of an object or of a selection, [P] bool; NotFound if there is none of that name."""
        if splat_set.kind != "selection":
            return self.members(int(splat_set.name))
        selection = self.selections.get(splat_set.name)
        if selection is None:
            names = ", ".join(list(self.selections)[:20]) or "none yet"
            raise NotFound("selection", expected=f"a selection of the scene: {names}", got=repr(splat_set.name))
        return selection.splats

    def without(self, sets: Sequence[str]) -> Self:
        """Return a copy for pictures, in which splats of sets (``object:N``, ``selection:NAME``) are unseen."""
        import torch

        from liftcore.query.terms import parse_set

        if not sets:
            return self
        members = [self.set_members(parse_set(notation, f"hide.{place}")) for place, notation in enumerate(sets)]
        unseen = torch.from_numpy(np.logical_or.reduce(members)).to(self.splats.opacity_logits.device)
        splats, scene = copy(self.splats), copy(self)
        object.__setattr__(splats, "opacity_logits", splats.opacity_logits.masked_fill(unseen, -torch.inf))
        scene.__dict__.pop("raster", None)
        scene.__dict__["splats"] = splats
        return scene

    def within(self, members: np.ndarray) -> Self:
        """Return a copy of the lift in which only some splats [P] bool have features, with nodes as its objects.

        Means and shares of total weight are those of these splats, so that a query distinguishes among them.
        """
        inner = copy(self)
        for name in (
            "has_feature",
            "all_have_features",
            "weights",
            "effective_count",
            "mean",
            "distinct",
            "object_numbers",
            "object_means",
            "principal",
        ):
            inner.__dict__.pop(name, None)
        inner._has_feature = self.has_feature & members
        inner.total_weight = np.where(members, self.total_weight, np.float32(0.0))
        rows = np.flatnonzero(inner._has_feature)
        rows = rows[:: -(-len(rows) // MOST_SAMPLED) or 1]
        inner.__dict__["rough_mean"] = self.features.mean(self.total_weight[rows], rows)
        if self.node is not None and self.node_views is not None:
            inner.object, inner.object_views = self.node, self.node_views
        inner.node_features = None  # of all splats of the nodes
        return inner

    def mean_of(self, rows: np.ndarray) -> np.ndarray:
        """Compute the unit mean [F] f32 of the unit features of splats [n] by total weight; of many, by a sample."""
        rows = rows[:: -(-len(rows) // MOST_OF_OBJECT) or 1]
        weights = self.total_weight[rows]
        mean = self.features.mean(weights if weights.any() else weights + 1, rows)
        return mean / max(float(np.linalg.norm(mean)), 1e-30)

    @cached_property
    def principal(self) -> Tensor:
        """[P, 3] f32 in 0..1, the features as colours."""
        from liftcore.query.splat_colours import principal_colours

        colours = principal_colours(self.features.rows, self.features.of_rows(self.total_weight))
        return colours if self.features.code is None else colours[self.features.code.astype(np.int64)]

    @cached_property
    def splat_file(self) -> Path:
        """The file of the splats that were lifted; of values in memory a temporary one.

        Raises:
            InvalidLift: it moved, is another than the one that was lifted, or has another number of splats.
        """
        if not self.metadata.splats.path and "splats" in self.__dict__:
            from liftcore.io.splats import write_splats

            folder = Path(mkdtemp(prefix="splatlift-"))
            finalize(self, rmtree, folder, ignore_errors=True)
            write_splats(folder / "splats.ply", self.splats)
            return folder / "splats.ply"
        path = self._verified_input("splats", self.metadata.splats)
        self._require_rows(quick_count(path))
        return path

    def _require_rows(self, splats: int | None) -> None:
        """Raise InvalidLift if the lift's rows are not those of its splats: answers would be of other splats.

        Args:
            splats: their number; None if it is not known yet.
        """
        if splats not in (None, len(self.features)):
            raise InvalidLift(
                str(self.path), expected=f"a row for each of its {splats} splats", got=f"{len(self.features)} rows",
                hint=TRANSFER,
            )  # fmt: skip

    @cached_property
    def splats(self) -> Splats:
        """The splats that were lifted.

        Raises:
            InvalidLift: their file moved, or is another than the one that was lifted.
        """
        from liftcore.io.splats import read_splats

        splats = read_splats(self.splat_file, self.kernel)
        self._require_rows(splats.count)
        return splats

    @property
    def kernel(self) -> str:
        """The kernel of the lift; ``auto`` if its diagnostics do not have it."""
        setting = self.metadata.settings.kernel
        plan = self.metadata.diagnostics.get("plan")
        lifted = plan.get("kernel") if setting == "auto" and isinstance(plan, dict) else setting
        return str(lifted) if lifted in set(Kernel) else setting

    @cached_property
    def axes(self) -> np.ndarray:
        """[3, P], `Splats.positions` axis by axis: a box around many of them takes a fifth of the time."""
        if "splats" in self.__dict__:
            return np.ascontiguousarray(self.splats.positions().T)
        from liftcore.io.splats import read_places

        places = read_places(self.splat_file, self.kernel)
        self._require_rows(len(places))
        return np.ascontiguousarray(places.T)

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras of the scene, all of them, also those that the lift left out.

        Raises:
            InvalidLift: their file moved, or is another than the one that was lifted.
        """
        from liftcore.io.cameras import read_cameras

        return read_cameras(self._verified_input("cameras", self.metadata.cameras))

    @cached_property
    def packs(self) -> Views:
        """The feature packs of the lift; queries by region read a row of them.

        Raises:
            InvalidLift: a pack moved, or is another than the one that was lifted.
        """
        from liftcore.values.pack import read_features

        return read_features(*(self._verified_input("features", file) for file in self.metadata.features))

    def find_packs(self, paths: Sequence[Path]) -> None:
        """Set new paths of the feature packs, in the lift's order, if they moved since the lift."""
        files = zip(self.metadata.features, paths, strict=True)
        new_files = tuple(file.model_copy(update={"path": str(path)}) for file, path in files)
        self.metadata = self.metadata.model_copy(update={"features": new_files})

    @cached_property
    def raster(self) -> Raster:
        """A for this scene."""
        from liftcore.raster import open_raster
        from liftcore.runtime.device import CPU

        return open_raster(self.splats, CPU)

    @property
    def compositing(self) -> CompositingParams:
        """Parameters that scores are rendered with: the lift's rendering scale of the opacity logits."""
        return self.metadata.settings.compositing

    def camera(self, view: str | Camera) -> Camera:
        """Return the camera of a name; a camera is returned as it is.

        Raises:
            NotFound: no camera has this name.
            InvalidLift: the cameras moved or changed since the lift.
        """
        return self.cameras[view] if isinstance(view, str) else view

    def image(self, view: str | Camera, draw: Callable[[Camera], Tensor]) -> Tensor:
        """Render an image [H, W, ..] of a view in its photo's pixels, by a function for pinholes (`in_photo`).

        Args:
            view: the name of a camera of the scene, or any camera in the frame of the splats.

        Raises:
            NotFound: no camera has this name.
            InvalidQuery: its image is larger than pictures may be.
            InvalidLift: the cameras moved or changed since the lift.
        """
        from liftcore.scene.cameras import drawn_by
        from liftcore.scene.drawing import in_photo

        camera = self.camera(view)
        for width, height in (camera.photo_size, drawn_by(camera).photo_size):
            if width * height > MOST_PIXELS:
                raise InvalidQuery(
                    "view", expected=f"an image of at most {MOST_PIXELS} pixels to draw",
                    got=f"{width}x{height} in {camera.name!r}" + (", for its distorted photo" if camera.lens else ""),
                    hint="give the scene a camera of that pose with width, height, fx, fy, cx and cy divided alike",
                )  # fmt: skip
        return in_photo(camera, draw)

    def _verified_input(self, role: str, record: InputFile) -> Path:
        """Return the path of an input whose bytes are those that were lifted.

        Raises:
            InvalidLift: there is no such file.
        """
        if not record.path:
            raise InvalidLift(str(self.path), expected=f"a lift with a path of its {role}", got="values in memory",
                              hint=f"give the {role} that were lifted, {role}=")  # fmt: skip
        from liftcore.io.transforms import FRAME_FILE
        from liftcore.values.lift_file import found_input

        path, is_moved = Path(record.path), self._new_paths.get(role) is not None
        if role == "splats" and is_moved and not record.sha256 and path.exists():
            return path  # of values in memory, of which only the number is known
        verified_path = found_input(role, record, self.metadata, None if is_moved else self.path)
        if verified_path is not None:
            return verified_path
        option = f"say where they are with --{role} (in Python {role}=), or " if role in ("splats", "cameras") else ""
        if not path.exists():
            raise InvalidLift(
                str(self.path), expected=f"its {role} at {path}, or beside the lift", got="nothing there",
                hint=f"{option}move the {role} back or beside the lift",
            )  # fmt: skip
        remedy = f"restore them; {TRANSFER}" if role == "splats" else "restore them, or lift again"
        note = f" ({FRAME_FILE} beside them counts too)" if role == "cameras" else ""
        raise InvalidLift(
            str(self.path), expected=f"the {role} that were lifted at {path}", got="a file with another SHA-256",
            hint=f"the {role} changed since the lift{note}: {option}{remedy}",
        )  # fmt: skip


def as_numpy(array: Any) -> Any:
    """Return a NumPy array over the same memory if it is on the CPU, else a copy; None stays None."""
    if array is None or isinstance(array, np.ndarray):
        return array
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)
