"""A lift opened once: what questions to it share, with the splats, cameras and packs that it was made from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from liftcore.errors import InvalidLift, InvalidQuery, NotFound
from liftcore.io.splats import quick_count
from liftcore.query.scores import mean_direction, norms_of
from liftcore.runtime.aliases import deprecated_names
from liftcore.scene.kernel import Kernel
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text.table import TableEncoder, own_words
from liftcore.values.lift_file import NODE_TENSORS, OBJECT_TENSORS, OLD_TENSORS, read_lift

if TYPE_CHECKING:  # these load torch
    from torch import Tensor

    from liftcore.query.question import Box
    from liftcore.query.selections import Selection
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Camera, Cameras
    from liftcore.scene.compositing import CompositingParams
    from liftcore.scene.splats import Splats
    from liftcore.text import TextEncoder
    from liftcore.values.lift import InputFile, Lift, LiftMetadata
    from liftcore.values.pack import Views

MOST_SAMPLED = 1 << 14  # splats of which a rough mean is taken
MOST_OF_THING = 512  # splats of a thing, likewise
MOST_PIXELS = 1 << 26  # of a picture: 67 million take a minute of one core and 2 GB


@deprecated_names(**OLD_TENSORS)
class OpenedLift:
    """A lift, with the splats and cameras of its scene: what `liftcore.query.scene.Scene` asks.

    Arguments and errors are those of `Scene`. Norms, mean, axes and encoders are made once and kept.
    """

    features: np.ndarray
    """[P, F] f16 or f32; zero rows where not seen"""
    total_weight: np.ndarray
    """[P] f32"""
    cluster: np.ndarray | None
    """[P] i32, -1 = in no cluster; None without aggregation"""
    cluster_features: np.ndarray | None
    """[K, F] like features"""
    confidence: np.ndarray | None
    """[P] f32 in 0..1; None where the lift was not reweighted"""
    object: np.ndarray | None
    """[P] i32, -1 = of no object; None: objects were not looked for"""
    object_views: np.ndarray | None
    """[N, V] i32, of `Lift`"""
    node: np.ndarray | None
    """[P] i32, the smallest node of each splat (`Lift`); None in lifts without a tree"""
    node_parents: np.ndarray | None
    """[T] i32, -1 for none"""
    node_views: np.ndarray | None
    """[T, V] i32"""
    node_confidence: np.ndarray | None
    """[T] f32 in 0..1"""
    node_features: np.ndarray | None
    """[T, F] f16, unit; zero for none"""
    _told: str
    """the metadata of a lift file, as JSON"""
    _moved: dict[str, Path | None]
    """files that lie elsewhere now, by their roles"""

    def __init__(
        self,
        source: Lift | Path | str,
        splats: Splats | Path | str | None = None,
        cameras: Mapping[str, Camera] | Path | str | None = None,
        packs: Views | None = None,
        *,
        device: str = "cpu",
        world: WorldFrame = UNKNOWN,
    ) -> None:
        self.device, self._said_of_world = device, world
        self.labelled: tuple[Any, Any] | None = None  # what was last exported, and its `Labels`, for two files of it
        self.selections: dict[str, Selection] = {}  # by their names; `Scene.select` makes them
        self.node_boxes: dict[tuple[int, int], Box] = {}  # of listed nodes, by their ids and numbers of splats
        self.object_features: np.ndarray | None = None  # [N, F], of `liftcore.query.catalogue.object_features`
        self._encoders: dict[str | None, TextEncoder] = {}
        places = {"splats": splats, "cameras": cameras}
        self._moved = {role: Path(at) if isinstance(at, str | Path) else None for role, at in places.items()}
        if isinstance(source, str | Path):
            self.path = Path(source)
            arrays, self._told = read_lift(self.path)
            moved = self._moved["splats"]
            given: dict[str, Any] = {}
        else:
            names = ("features", "total_weight", "seen", "cluster", "cluster_features", "confidence", "embeddings")
            arrays = {name: as_numpy(getattr(source, name)) for name in (*names, *OBJECT_TENSORS, *NODE_TENSORS)}
            self.path, moved = Path("lift"), None
            given = {"lift": source, "metadata": self._with_places(source.metadata)}
        self._hold(arrays)
        if moved is not None and moved.exists():
            self._require_rows(quick_count(moved))
        given |= {"cameras": cameras} if cameras is not None and self._moved["cameras"] is None else {}
        given |= {"packs": packs} if packs is not None else {}
        self.__dict__.update(given)
        if splats is not None and not isinstance(splats, str | Path):
            self.lift.require_splats(splats)
            self.__dict__["splats"] = splats.cpu()

    def _hold(self, arrays: dict[str, Any]) -> None:
        columns = (arrays[name] for name in ("features", "total_weight", "seen"))
        self.features, self.total_weight, self._has_feature = columns
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
        """The encoder of a specification, opened once and with its last texts remembered; one of yours as it is.

        None: the lift's own words, else that of its text space.

        Args:
            hint: what to do where there is none. stand_in: where the weights of the space's encoder cannot be had,
                take the table of it that ships, which knows its own words alone.

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
            opened = encoder_of_space(space, hint, stand_in=stand_in) if key is None else open_encoder(key)
            self._encoders[key] = CachingEncoder(opened)
        return self._encoders[key]

    @cached_property
    def metadata(self) -> LiftMetadata:
        """How the lift was made, with its files where they are now; read when first asked for.

        Raises:
            InvalidLift: the metadata are none of a lift, or the lift has not a row for each of the splats that they
                name.
        """
        from liftcore.values.lift_file import input_file, parse_metadata

        metadata = parse_metadata(self._told, self.path)
        splats = Path(metadata.splats.path)
        if metadata.splats.path and self._moved["splats"] is None and splats.exists():
            count = quick_count(splats)
            # Another file may lie there now, which says nothing of this lift.
            if count not in (None, len(self.features)) and input_file(splats).sha256 == metadata.splats.sha256:
                self._require_rows(count)
        return self._with_places(metadata)

    def _with_places(self, metadata: LiftMetadata) -> LiftMetadata:
        """The metadata with the files that moved where they are now."""
        files = {
            name: getattr(metadata, name).model_copy(update={"path": str(place)})
            for name, place in self._moved.items()
            if place is not None
        }
        return metadata.model_copy(update=files) if files else metadata

    @cached_property
    def world(self) -> WorldFrame:
        """Which way is up and how long a unit is, as somebody says now, else as the lift knows it; may be set."""
        return self._said_of_world.known_or(self.metadata.world)

    @cached_property
    def table(self) -> TableEncoder | None:
        """The words that its packs brought: an encoder for these; None without any.

        Raises:
            InvalidTable: its words and their vectors do not fit together.
        """
        return own_words(self.metadata.words, self._embeddings)

    @cached_property
    def lift(self) -> Lift:
        """The lift as torch has it, over the same memory."""
        from liftcore.values.lift_file import open_lift

        return open_lift(self.path)

    @property
    def channels(self) -> int:
        """F."""
        return int(self.features.shape[1])

    @cached_property
    def norms(self) -> np.ndarray:
        """[P] f32, the features' norms."""
        return norms_of(self.features)

    @cached_property
    def seen(self) -> np.ndarray:
        """[P] bool, whether a splat has a feature."""
        return self._has_feature & (self.norms > 0)

    @cached_property
    def all_seen(self) -> bool:
        """Whether every splat has one."""
        return bool(self.seen.all())

    @cached_property
    def weights(self) -> np.ndarray | None:
        """How much each seen splat counts in a histogram, its total weight; None when none has total weight."""
        return self.weights_with_feature(self.total_weight)

    def splat_weights(self, weight_by: str) -> np.ndarray:
        """[P] f32, how much each splat counts: by its total weight, or by that times its confidence.

        Raises:
            InvalidQuery: the lift has no confidence.
        """
        if weight_by == "evidence":
            return self.total_weight
        if self.confidence is None:
            hint, got = "lift again with the preset default, or with robust_steps", "a lift that was not reweighted"
            raise InvalidQuery("weight_by", expected="a lift with confidence", got=got, hint=hint)
        return self.total_weight * self.confidence

    def weights_with_feature(self, weights: np.ndarray) -> np.ndarray | None:
        """Weights [P] of the seen splats; None when none is above zero, so that they count alike."""
        weights = weights if self.all_seen else weights[self.seen]
        return weights if weights.max(initial=0.0) > 0 else None

    @cached_property
    def mean(self) -> np.ndarray:
        """[F] f32, the mean of the unit features, weighted by total weight: what all the scene's features share."""
        return mean_direction(self.features, self.norms, self.total_weight)

    @cached_property
    def rough_mean(self) -> np.ndarray:
        """[F] f32, the mean of at most MOST_SAMPLED of them, evenly spaced: quicker, and near enough for words."""
        rows = slice(None, None, -(-len(self.features) // MOST_SAMPLED) or 1)
        return mean_direction(self.features[rows], self.norms[rows], self.total_weight[rows])

    @cached_property
    def object_means(self) -> np.ndarray:
        """[N, F] f32, the unit mean of the features of each object of the lift (`mean_of`)."""
        assert self.object is not None and self.object_views is not None
        own = np.where(self.seen, self.object, -1)
        order = np.argsort(own, kind="stable")
        ends = np.searchsorted(own[order], np.arange(len(self.object_views) + 1))
        means = [self.mean_of(order[first:last]) for first, last in pairwise(ends.tolist())]
        return np.stack(means) if means else np.zeros((0, self.channels), np.float32)

    def node_path(self, node: int) -> tuple[int, ...]:
        """The nodes of the tree that hold a node, the largest first, and itself."""
        assert self.node_parents is not None
        found = [node]
        while (above := int(self.node_parents[found[-1]])) >= 0:
            found.append(above)
        return tuple(reversed(found))

    def node_kind(self, node: int) -> Literal["object", "part", "group"]:
        """What a node of the tree is: the first are the objects."""
        objects = 0 if self.object_views is None else len(self.object_views)
        if node < objects:
            return "object"
        return "part" if min(self.node_path(node)) < objects else "group"

    def lack_of_objects(self) -> str:
        """Why a lift has none, and what gives it some."""
        settings = self.metadata.settings
        if settings.objects is False:
            why = "speed=draft sets it" if settings.speed == "draft" else "they were not asked for"
            return f"this lift looked for no objects, with objects=false ({why}): lift again with objects=auto"
        return (
            "this lift holds no objects: they are found by lifts of masks, by the preset default or the setting "
            "objects; grids have no masks"
        )

    def members(self, number: int) -> np.ndarray:
        """[P] bool, the splats of an object, or of another node of the tree with its parts.

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
        return below[self.node]  # the last place is of no node

    def within(self, members: np.ndarray) -> Self:
        """The same lift as if nothing but some of its splats [P] bool were seen; the tree's nodes are its things.

        Means and shares of total weight are those of these splats, so that a question tells them from one another.
        """
        inner = copy(self)
        for name in ("seen", "all_seen", "weights", "mean", "object_means", "principal"):
            inner.__dict__.pop(name, None)
        inner._has_feature = self.seen & members
        inner.total_weight = np.where(members, self.total_weight, np.float32(0.0))
        rows = np.flatnonzero(inner._has_feature)
        rows = rows[:: -(-len(rows) // MOST_SAMPLED) or 1]
        inner.__dict__["rough_mean"] = mean_direction(self.features[rows], self.norms[rows], self.total_weight[rows])
        if self.node is not None and self.node_views is not None:
            inner.object, inner.object_views = self.node, self.node_views
        inner.node_features = None  # of all splats of the nodes
        return inner

    def mean_of(self, rows: np.ndarray) -> np.ndarray:
        """[F] f32, the unit mean of unit features of splats [n] by total weight; of many, of evenly spaced ones."""
        rows = rows[:: -(-len(rows) // MOST_OF_THING) or 1]
        weights = self.total_weight[rows]
        mean = mean_direction(self.features[rows], self.norms[rows], weights if weights.any() else weights + 1)
        return mean / max(float(np.linalg.norm(mean)), 1e-30)

    @cached_property
    def principal(self) -> Tensor:
        """[P, 3] f32 in 0..1, the features as colours."""
        from liftcore.query.splat_colours import principal_colours

        return principal_colours(self.features, self.total_weight)

    @cached_property
    def splat_file(self) -> Path:
        """The file of the splats that were lifted; of values in memory one that goes with the scene.

        Raises:
            InvalidLift: it moved, is another than the one that was lifted, or has another number of splats.
        """
        if not self.metadata.splats.path and "splats" in self.__dict__:
            from liftcore.io.splats import write_splats

            self._folder = TemporaryDirectory(prefix="splatlift-", ignore_cleanup_errors=True)
            path = Path(self._folder.name) / "splats.ply"
            write_splats(path, self.splats)
            return path
        path = self._unchanged("splats", self.metadata.splats)
        self._require_rows(quick_count(path))
        return path

    def _require_rows(self, splats: int | None) -> None:
        """Refuse a lift whose rows are not those of its splats: each answer would name others.

        Args:
            splats: how many there are; None where that is not known yet.
        """
        if splats not in (None, len(self.features)):
            raise InvalidLift(
                str(self.path), expected=f"a row for each of its {splats} splats", got=f"{len(self.features)} rows",
                hint="crop the splats with their lift, or lift the cropped splats again",
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
        """The kernel that was lifted with; ``auto`` where the lift does not say what that was."""
        chosen = self.metadata.settings.kernel
        plan = self.metadata.diagnostics.get("plan")
        lifted = plan.get("kernel") if chosen == "auto" and isinstance(plan, dict) else chosen
        return str(lifted) if lifted in set(Kernel) else chosen

    @cached_property
    def axes(self) -> np.ndarray:
        """[3, P], `Splats.positions` axis by axis: a box around many of them is found five times faster so."""
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

        # Which of several models was meant, the lift knew: its digest tells that the same is read.
        path = self._unchanged("cameras", self.metadata.cameras)
        return read_cameras(path, choosing=False, views=self.metadata.views)

    @cached_property
    def packs(self) -> Views:
        """The feature packs that were lifted; queries by region read a row of them.

        Raises:
            InvalidLift: a pack moved, or is another than the one that was lifted.
        """
        from liftcore.values.pack import read_features

        return read_features(*(self._unchanged("features", file) for file in self.metadata.features))

    def find_packs(self, paths: Sequence[Path]) -> None:
        """Say where the feature packs lie now, when they moved since the lift; in the lift's order."""
        files = zip(self.metadata.features, paths, strict=True)
        moved = tuple(file.model_copy(update={"path": str(path)}) for file, path in files)
        self.metadata = self.metadata.model_copy(update={"features": moved})

    @cached_property
    def raster(self) -> Raster:
        """A for this scene, on the device that draws."""
        from liftcore.raster import open_raster
        from liftcore.runtime.device import choose_device

        return open_raster(self.splats, choose_device(self.device))

    @property
    def compositing(self) -> CompositingParams:
        """How scores are rendered: with the lift's rendering scale of the opacity logits."""
        return self.metadata.settings.render_params

    def camera(self, view: str | Camera) -> Camera:
        """The camera of that name; a camera itself needs none of the lift's.

        Raises:
            NotFound: no camera has this name.
            InvalidLift: the cameras moved or changed since the lift.
        """
        return self.cameras[view] if isinstance(view, str) else view

    def image(self, view: str | Camera, draw: Callable[[Camera], Tensor]) -> Tensor:
        """A picture [H, W, ..] of a view in its photo's pixels, from what draws one of a pinhole (`in_photo`).

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

    def _unchanged(self, role: str, remembered: InputFile) -> Path:
        """The path of an input, once its bytes are known to be those that were lifted."""
        if not remembered.path:
            raise InvalidLift(str(self.path), expected=f"a lift that knows its {role}", got="one of values in memory",
                              hint=f"give the {role} that were lifted, {role}=")  # fmt: skip
        from liftcore.io.transforms import FRAME_FILE
        from liftcore.values.lift_file import found_input

        path, moved = Path(remembered.path), self._moved.get(role) is not None
        if role == "splats" and moved and not remembered.sha256 and path.exists():
            return path  # of values in memory, so nothing says more than how many they are
        found = found_input(role, remembered, self.metadata, None if moved else self.path)
        if found is not None:
            return found
        option = f"say where they are with --{role} (in Python {role}=), or " if role in ("splats", "cameras") else ""
        if not path.exists():
            raise InvalidLift(
                str(self.path), expected=f"its {role} at {path}, or beside the lift", got="nothing there",
                hint=f"{option}move the {role} back or beside the lift",
            )  # fmt: skip
        beside = f" ({FRAME_FILE} beside them counts too)" if role == "cameras" else ""
        raise InvalidLift(
            str(self.path), expected=f"the {role} that were lifted at {path}", got="a file with another SHA-256",
            hint=f"the {role} changed since the lift{beside}: {option}restore them, or lift again",
        )  # fmt: skip


def as_numpy(array: Any) -> Any:
    """A NumPy array over the same memory where it lies on the CPU, else a copy of it; None stays None."""
    if array is None or isinstance(array, np.ndarray):
        return array
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)
