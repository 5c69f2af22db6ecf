"""Scene, a lift opened for queries, with the splats and cameras of its scene: the face of all queries."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from copy import copy
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, Literal, Self, TypeAlias, get_args
from weakref import finalize

import numpy as np

from liftcore.errors import InvalidLift, InvalidQuery, NotFound
from liftcore.io.splats import quick_count
from liftcore.query.colours import NOT_SEEN_COLOUR, cluster_colours, heat_colours
from liftcore.query.scores import Features, cosines, norms_of, spaced
from liftcore.runtime.arguments import check_choice
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.kernel import Kernel
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text.table import TableEncoder, own_words
from liftcore.values.lift_file import read_lift, tensors_of

if TYPE_CHECKING:  # these load torch
    from PIL.Image import Image
    from torch import Tensor

    from liftcore.io.labels import Labels
    from liftcore.query.question import Answer, BestWord, Box, Objects, Query, SceneTree, SuggestedWords
    from liftcore.query.render import ViewMask
    from liftcore.query.segment import Segmentation
    from liftcore.query.selections import Selection
    from liftcore.query.terms import Example, SplatSet
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Camera, Cameras
    from liftcore.scene.compositing import CompositingParams
    from liftcore.scene.splats import Splats
    from liftcore.text import TextEncoder
    from liftcore.values.lift import InputFile, Lift, LiftMetadata

Source: TypeAlias = (  # of a file
    "Query | str | Answer | Mapping[str, Answer] | Segmentation | SceneTree | np.ndarray | int | None"
)
AnyEncoder: TypeAlias = "TextEncoder | str | Path | None"  # or the specification of one; None: that of the lift

OF_SPLATS = (  # values that are computed once, of splats with a feature and their total weight
    "has_feature", "weights", "norms", "effective_count", "mean", "rough_mean", "distinct",
    "object_numbers", "object_means", "principal",
)  # fmt: skip
MOST_SAMPLED = 1 << 14  # splats of which a rough mean is computed
MOST_OF_OBJECT = 512  # splats of an object, likewise
TRANSFER = (
    "edited splats need a lift of their own, which 'splatlift transfer LIFT EDITED --splats LIFTED -o NEW' makes of "
    "this one (in Python lift.transferred)"
)
MOST_PIXELS = 1 << 26  # of a picture: 67 million take a minute of one core and 2 GB


class Scene:
    """A lift opened for queries, with the splats and cameras of its scene.

    Norms, mean, axes and encoders are computed once and cached. Scores need the lift alone, and no torch. Splats
    and cameras that are not passed are read from the paths in the lift, once and at first use, and verified by
    their digests.

    Args:
        source: the lift, or the path of its file, which is mapped and not read.
        splats: that were lifted, or their new path if they moved. cameras: of the scene, or their path.
        world: up axis and length unit, if the lift has none, or wrong ones.

    Raises:
        InvalidLift: the file is missing, is not a lift, or has other rows than the file of ``splats``, if these can
            be counted without reading them.
        InvalidSplats: other splats than were lifted (`Lift.require_splats`).
    """

    features: Features
    """[P, F], exact or as codes; zero rows without a feature"""
    selections: dict[str, Selection]
    """selections by their names (`select`)"""
    # The tensors of `liftcore.values.lift.Lift`, as arrays.
    total_weight: np.ndarray
    cluster: np.ndarray | None = None
    confidence: np.ndarray | None = None
    object: np.ndarray | None = None
    object_views: np.ndarray | None = None
    node: np.ndarray | None = None
    node_parents: np.ndarray | None = None
    node_views: np.ndarray | None = None
    node_confidence: np.ndarray | None = None
    node_features: np.ndarray | None = None
    embeddings: np.ndarray | None = None
    _has_feature: np.ndarray
    _metadata_json: str  # of a lift file
    _new_paths: dict[str, Path]  # of files that were moved, by their roles

    def __init__(
        self,
        source: Lift | Path | str,
        splats: Splats | Path | str | None = None,
        cameras: Mapping[str, Camera] | Path | str | None = None,
        *,
        world: WorldFrame = UNKNOWN,
    ) -> None:
        self._world_override = world
        self.labelled: tuple[Any, Labels] | None = None  # of the last exported source, for the next file
        self.selections = {}
        self.node_boxes: dict[tuple[int, int], Box] = {}  # of listed nodes, by their ids and numbers of splats
        self._encoders: dict[str | None, TextEncoder] = {}
        paths = {"splats": splats, "cameras": cameras}
        self._new_paths = {role: Path(at) for role, at in paths.items() if isinstance(at, str | Path)}
        if isinstance(source, str | Path):
            self.path = Path(source)
            arrays, self._metadata_json = read_lift(self.path)
        else:
            self.path, arrays = Path("lift"), {name: as_numpy(tensor) for name, tensor in tensors_of(source).items()}
            self.__dict__ |= {"lift": source, "metadata": self._with_places(source.metadata)}
        features, code = arrays.pop("features"), arrays.pop("code", None)
        self.features = Features(features if code is None else features.astype(np.float32), code)
        self._has_feature = arrays.pop("has_feature")
        views = arrays.get("object_views")
        if views is not None and "node" not in arrays:  # every object is a node without parts
            parents = np.full(len(views), -1, np.int32)
            arrays |= {"node": arrays["object"], "node_parents": parents, "node_views": views}
        self.__dict__.update(arrays)
        if "splats" in self._new_paths and self._new_paths["splats"].exists():
            self._require_rows(quick_count(self._new_paths["splats"]))
        if cameras is not None and not isinstance(cameras, str | Path):
            self.__dict__["cameras"] = cameras
        if splats is not None and not isinstance(splats, str | Path):
            self.lift.require_splats(splats)
            self.__dict__["splats"] = splats.cpu()

    def __repr__(self) -> str:
        objects = "" if self.object_views is None else f", {len(self.object_views)} objects"
        return f"Scene({len(self.features)} splats, {self.channels} channels{objects})"

    def ask(self, query: Query | str, *, encoder: AnyEncoder = None, places: bool | None = None) -> Answer:
        """Score every splat for a query and select those that answer it (`liftcore.query.ask`).

        Args:
            query: words and examples, or one text.
            encoder: of texts, or the specification of one, which is opened once. None: the lift's own words, else
                that of its text space, or its shipped table.
            places: True to list the best splats and the box of the selection, which needs the splats; None: if these
                are available.

        Raises:
            InvalidQuery: a text that the encoder cannot encode or no encoder of the lift's space, a term that has no
                feature.
            NotFound: an example names a view that does not exist.
            InvalidLift: an example or ``places`` need the scene's files, and they moved or changed.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import ask

        answer = ask(self, query, encoder)
        if places is False:
            return answer
        with nullcontext() if places else suppress(InvalidLift):
            return self.locate(answer)
        return answer

    def locate(self, answer: Answer, count: int | None = None) -> Answer:
        """Add to an answer its best splats, and the box around all selected ones.

        A single outlier stretches the box; boxes of ``objects`` are without outliers.

        Args:
            count: of the best splats; None = the query's. Equal scores are ordered by their rows.

        Raises:
            InvalidLift: the splats moved or changed since the lift.
        """
        from liftcore.query.objects import point_of
        from liftcore.query.question import Box, TopSplat

        places, count = self.axes, answer.query.top if count is None else count
        rows = np.flatnonzero(answer.has_feature)
        scores = answer.scores[rows]
        if 0 < count < len(scores):
            last = np.partition(scores, len(scores) - count)[len(scores) - count]
            rows = np.concatenate([rows[scores > last], rows[scores == last]])[:count]
        best = rows[np.argsort(-answer.scores[rows], kind="stable")][:count]
        top = tuple(
            TopSplat(splat=int(row), score=float(answer.scores[row]), position=point_of(places[:, row]))
            for row in best
        )
        selected = places.take(np.flatnonzero(answer.selected), axis=1)
        box = Box(point_of(selected.min(axis=1)), point_of(selected.max(axis=1))) if answer.count else None
        return answer.replace(top=top, box=box)

    def best_view(self, answer: Answer) -> str | None:
        """Return the view that shows most of the object with the most selected splats, or else the first view."""
        views, objects = self.metadata.views, self.object
        if objects is not None and self.object_views is not None and (answer.selected & (objects >= 0)).any():
            largest = np.bincount(objects[answer.selected & (objects >= 0)]).argmax()
            return views[max(int(self.object_views[largest, 0]), 0)]
        return views[0] if views else None

    def view_mask(
        self, query: Query | str | Answer, view: str | Camera | None = None, *, encoder: AnyEncoder = None
    ) -> ViewMask:
        """Render an answer from a camera: its attention, and a mask of the objects that were found.

        Args:
            query: as in `ask`, or the answer to it. view: the name of a camera of the scene, or any camera in the
                frame of the splats; None: the query's own.

        Raises:
            InvalidQuery, NotFound, InvalidLift, Unavailable: as `ask` and `liftcore.query.render.view_mask`.
        """
        from liftcore.query.render import view_mask

        answer = self._answer(query, encoder)
        return view_mask(self, answer, answer.query.seen_from() if view is None else view)

    def mask(
        self, query: Query | str | Answer, view: str | Camera | None = None, *, encoder: AnyEncoder = None
    ) -> np.ndarray:
        """Return the pixels of a view with the answer's objects, [H, W] bool; arguments as in `view_mask`."""
        return self.view_mask(query, view, encoder=encoder).mask

    def select(self, name: str, source: Answer | Query | str | np.ndarray | Tensor | int | None = None) -> Selection:
        """Return the selection of a name, a new one if there is none; `Selection.edit` changes its splats.

        Queries take it as ``Query(sets=["selection:NAME"])``, and as an example by ``like="selection:NAME"``.

        Args:
            source: of its splats, as in `Selection.edit`; None: it stays as it is.

        Raises:
            InvalidQuery: a name that queries cannot take; or as `Selection.edit`, like NotFound and InvalidLift.
        """
        from liftcore.query.selections import Selection
        from liftcore.query.terms import parse_set

        parse_set(f"selection:{name}", "name")
        selection = self.selections.get(name) or Selection(self, name)
        if source is not None:
            selection.edit("set", source)  # an invalid source leaves no selection
        self.selections[name] = selection
        return selection

    def render(self, view: str | Camera, channel: str = "rgb", hide: Sequence[str] = ()) -> np.ndarray:
        """Render a view: ``rgb``, ``pca``, ``cluster`` or ``confidence``, [H, W, 3] u8 sRGB; ``depth``, [H, W] f32.

        Depths are expected ones, in scene units, 0 where no splat is. Splats of the sets ``hide`` (``object:N``,
        ``selection:NAME``) are left out.

        Raises:
            NotFound, InvalidQuery, InvalidLift: as `liftcore.query.render.render`.
        """
        from liftcore.query.question import Rendered
        from liftcore.query.render import expected_depth, render

        check_choice("channel", channel, get_args(Rendered), InvalidQuery)
        scene = self.without(hide)
        return expected_depth(scene, view)[0] if channel == "depth" else render(scene, view, channel)

    def objects(self, query: Query | str | Answer, *, encoder: AnyEncoder = None) -> Objects:
        """Group the splats of an answer to objects of touching splats with boxes (`liftcore.query.objects`)."""
        from liftcore.query.objects import objects

        return objects(self, self._answer(query, encoder))

    def tree(self, words: Sequence[str] = (), vectors: Any = None, *, encoder: AnyEncoder = None) -> SceneTree:
        """List the objects on which masks of many views agree, found at lift time, with their parts and groups.

        Args:
            words: n, that name them. vectors: [n, F], torch or numpy, their text vectors, of any length above zero.
                None: the encoder computes them.
        """
        from liftcore.query.tree import tree

        if words and vectors is None:
            vectors = self.encoder(encoder).encode(words)
        return tree(self, words, vectors)

    def segment(
        self,
        words: Sequence[str] | None = None,
        vectors: Any = None,
        *,
        encoder: AnyEncoder = None,
        progress: Progress | bool | None = False,
    ) -> Segmentation:
        """Label every splat with the most similar word, or none (`liftcore.query.segment`).

        Args:
            words: n different ones; None: all words of the encoder, which is a table. vectors: as in `tree`.
            progress: as `liftcore.lift` has it.
        """
        from liftcore.query.presence import references_of
        from liftcore.query.segment import segment

        with shown_progress(progress) as reporter:
            if vectors is not None:
                return segment(self, words or (), vectors, reporter)
            reader = self.encoder(encoder)
            words = self.words(reader) if words is None else words
            references = references_of(reader, self.metadata.text_space)
            return segment(self, words, reader.encode(words), reporter, references)

    def nearest_words(
        self,
        example: Example | str | Sequence[float],
        words: Sequence[str] | None = None,
        *,
        top: int = 5,
        encoder: AnyEncoder = None,
    ) -> tuple[BestWord, ...]:
        """Return the words most similar to an example, the nearest first.

        Args:
            example: or its notation, as in `Query.like`, or a vector [F].
            words: None: all words of the encoder, which is a table.
        """
        from liftcore.query.directions import directions
        from liftcore.query.question import BestWord, Query

        reader = self.encoder(encoder)
        words = self.words(reader) if words is None else words
        fields: dict[str, Any] = {"like": [example]}
        query = Query(**fields)
        vars(query)["places"] = ["example"]  # for errors
        rows = np.asarray(as_numpy(reader.encode(words)), np.float32)
        scores = cosines(rows, norms_of(rows), directions(self, query, None))[:, 0]
        nearest = map(int, np.argsort(-scores, kind="stable")[:top])
        return tuple(BestWord(word=words[row], score=float(scores[row])) for row in nearest)

    def words(self, encoder: AnyEncoder = None) -> list[str]:
        """Return all words of an encoder that is a table, each once; another encoder is an InvalidQuery."""
        reader = self.encoder(encoder)
        words: Sequence[str] = getattr(reader, "words", ())
        if not words:
            expected, hint = f"words beside the encoder {reader.name}", "say what may be there"
            raise InvalidQuery("words", expected=expected, got="none", hint=hint)
        return list(dict.fromkeys(words))

    def suggested_words(self, text: str = "", limit: int = 8, *, encoder: AnyEncoder = None) -> SuggestedWords:
        """Suggest at most ``limit`` words that complete a text, and words of the lift's objects.

        Raises:
            InvalidQuery: the lift's text space names no encoder.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.directions import object_words
        from liftcore.query.presence import references_of, table_of
        from liftcore.query.question import SuggestedWord, SuggestedWords

        reader = self.encoder(encoder)
        table = table_of(reader)
        if table is not None:
            scene_words = object_words(self, table.words, table.embeddings)
            words = tuple(SuggestedWord(**word._asdict()) for word in table.vocabulary.complete(text, limit))
            return SuggestedWords(open_vocabulary=False, words=words, scene_words=scene_words)
        references = references_of(reader, self.metadata.text_space)
        scene_words = () if isinstance(references, str) else object_words(self, references.words, references.vectors)
        return SuggestedWords(open_vocabulary=True, words=(), scene_words=scene_words)

    def colours(self, layer: str) -> np.ndarray:
        """Colour all splats by a layer, [P, 3] u8 sRGB.

        ``pca`` are three principal components of the features, ``cluster`` a colour a cluster; ``total_weight`` (by
        its logarithm) and ``confidence`` go through the colour map of scores. Splats without a feature are grey.

        Raises:
            InvalidQuery: the lift has no clusters, or no confidence.
        """
        if layer == "pca":
            colours = np.round(255 * self.principal.numpy()).astype(np.uint8)
        elif layer == "cluster":
            clusters = self.layer("cluster")
            colours = cluster_colours(int(clusters.max()) + 1)[clusters]
        else:
            values = self.layer("confidence" if layer == "confidence" else "total_weight").astype(np.float32)
            valid = self.has_feature & np.isfinite(values)
            if layer == "total_weight":
                valid &= values > 0
                values = np.log(np.where(valid, values, 1.0))
            colours = heat_colours(values, valid)
        colours[~self.has_feature] = NOT_SEEN_COLOUR
        return colours

    def labels(self, source: Answer | Mapping[str, Answer] | Segmentation | SceneTree) -> Labels:
        """Return class and instance labels of all splats, as written to files (`liftcore.query.labels.labels`)."""
        from liftcore.query.labels import labels

        return labels(self, source)

    @staticmethod
    def warm_up(kernel: Kernel | None = None) -> None:
        """Load or compile the code of queries; with a kernel that of rendering such splats."""
        from liftcore.query.scores import warm_up

        if kernel is None:
            return warm_up()
        from liftcore.raster.cpu.warm_up import warm_up as warm_up_kernel

        return warm_up_kernel(kernel)

    def export(self, path: Path | str, source: Source = None, content: str = "", **options: Any) -> None:
        """Write a file, whole or not at all; arguments and errors as in `blocks_of`, with the suffix of the path."""
        from liftcore.io.files import whole_file

        options = {"suffix": Path(path).suffix.lower(), **options}
        blocks = self.blocks_of(source, content, **options)
        with whole_file(Path(path)) as handle:
            handle.writelines(blocks)

    def blocks_of(
        self,
        source: Source = None,
        content: str = "",
        *,
        view: str | Camera | None = None,
        suffix: str = "",
        view_mask: ViewMask | None = None,
        photo: Image | None = None,
        encoder: AnyEncoder = None,
    ) -> Iterable[bytes]:
        """Make a file, in blocks.

        Args:
            source: a query or its answer, answers by names, a segmentation, a tree, the id of an object or another
                node, or an array; None: the scene.
            content: of an answer object, coloured, scores, selection, mask, attention or overlay; of a segmentation
                coloured, labels, map or picture; of a tree csv, of its objects; of all these labelled
                (splats with labels), names (of the labels) or masks (COCO's JSON, in the views); of the scene a
                channel of `render`, or splats; of an array npy. Empty: the first of
                these; of a segmentation or a tree as a .glb or .usdz labelled (a tree as a .ply, too), .json masks.
            view: of pictures, as in `view_mask`; of masks the name of the only one.
            suffix: of its name, where there are several formats.
            view_mask: the answer's mask in the view, if it is cached. photo: of the view, for an overlay.

        Raises:
            InvalidQuery: there is no such file of the source, or the file would be empty.
            NotFound, InvalidLift, Unavailable: as the query, or as `render`.
        """
        from liftcore.query.export import Export, blocks_of
        from liftcore.query.question import Query

        source = self._answer(source, encoder) if isinstance(source, str | Query) else source
        return blocks_of(Export(self, source, content, view, suffix, view_mask, photo))

    def _answer(self, query: Query | str | Answer, encoder: AnyEncoder) -> Answer:
        from liftcore.query.question import Answer

        return query if isinstance(query, Answer) else self.ask(query, encoder=encoder, places=False)

    def encoder(
        self, encoder: AnyEncoder = None, *, hint: str = "give encoder=, or vectors", stand_in: bool = True
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
        if metadata.splats.path and "splats" not in self._new_paths and splats.exists():
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
        }
        return metadata.model_copy(update=files)

    @cached_property
    def world(self) -> WorldFrame:
        """Up axis and length unit, as passed to the scene, else as stored in the lift; may be set."""
        return self._world_override.known_or(self.metadata.world)

    @cached_property
    def table(self) -> TableEncoder | None:
        """The words of its packs, as an encoder; None without any. InvalidTable if its vectors are not theirs."""
        return own_words(self.metadata.words, self.embeddings)

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
    def weights(self) -> np.ndarray | None:
        """[n] f32, total weights of the splats with a feature; None, which means equal ones, if all are zero."""
        weights = self.total_weight[self.has_feature]
        return weights if weights.max(initial=0.0) > 0 else None

    def weights_of(self, rows: np.ndarray) -> np.ndarray:
        """Return the total weights [n] f64 of some splats; equal ones if all are zero."""
        weights = self.total_weight[rows].astype(np.float64)
        return weights if weights.any() else np.ones(len(weights))

    def layer(self, name: Literal["cluster", "total_weight", "confidence"]) -> np.ndarray:
        """Return a column for pictures, [P]; InvalidQuery if the lift does not have it."""
        column: np.ndarray | None = getattr(self, name)
        if column is None:
            hint = f"lift again with the setting {'aggregation' if name == 'cluster' else 'robust'}=true"
            raise InvalidQuery("channel", expected=f"a lift with {name}", got="a lift without", hint=hint)
        return column

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
        rows = self._copy(mean=self.mean, rough_mean=self.rough_mean, effective_count=self.effective_count)
        rows.features = Features(self.features.rows)
        rows.features.__dict__["norms"] = self.features.norms
        counts = self.features.of_rows(self.has_feature)
        rows._has_feature = counts > 0
        weights = self.features.of_rows(np.where(self.has_feature, self.total_weight, np.float32(0.0)))
        rows.total_weight = weights if weights.any() else counts
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

    @cached_property
    def node_paths(self) -> list[tuple[int, ...]]:
        """Of each node of the tree the nodes that contain it, the largest first, and itself."""
        assert self.node_parents is not None
        parents, paths = self.node_parents.tolist(), list[tuple[int, ...]]()
        for node in range(len(parents)):
            path = [node]
            while (above := parents[path[-1]]) >= 0:
                path.append(above)
            paths.append(tuple(reversed(path)))
        return paths

    def node_kind(self, node: int) -> Literal["object", "part", "group"]:
        """Return the kind of a node of the tree: the first nodes are the objects."""
        objects = 0 if self.object_views is None else len(self.object_views)
        if node < objects:
            return "object"
        return "part" if min(self.node_paths[node]) < objects else "group"

    def confidence_of(self, node: int) -> float | None:
        """Return the share of the views that see a node which have a mask of it; None in a lift without a tree."""
        return None if self.node_confidence is None else float(self.node_confidence[node])

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
        """Return the splats of an object, or of another node with its parts, [P] bool; NotFound if there is none."""
        nodes = 0 if self.node_parents is None else len(self.node_parents)
        if self.node is None or not 0 <= number < nodes:
            expected = f"a number from 0 to {nodes - 1}" if nodes else "a lift with objects"
            hint = "the list of the lift's objects has them" if nodes else self.lack_of_objects()
            raise NotFound("object", expected=expected, got=str(number), hint=hint)
        below = [number in path for path in self.node_paths]
        return np.array([*below, False])[self.node]  # the last entry is of splats without a node

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

    def _copy(self, **values: Any) -> Self:
        """Return a copy of the lift with some values of its splats, and without the others that were computed."""
        lift = copy(self)
        for name in OF_SPLATS:
            lift.__dict__.pop(name, None)
        lift.__dict__ |= values
        return lift

    def within(self, members: np.ndarray) -> Self:
        """Return a copy of the lift in which only some splats [P] bool have features, with nodes as its objects.

        Means and shares of total weight are those of these splats, so that a query distinguishes among them.
        """
        has_feature = self.has_feature & members
        rows = spaced(np.flatnonzero(has_feature), MOST_SAMPLED)
        inner = self._copy(rough_mean=self.features.mean(self.total_weight[rows], rows))
        inner._has_feature = has_feature
        inner.total_weight = np.where(members, self.total_weight, np.float32(0.0))
        inner.object, inner.object_views = self.node, self.node_views
        inner.node_features = None  # of all splats of the nodes
        return inner

    def mean_of(self, rows: np.ndarray) -> np.ndarray:
        """Compute the unit mean [F] f32 of the unit features of splats [n] by total weight; of many, by a sample."""
        rows = spaced(rows, MOST_OF_OBJECT)
        mean = self.features.mean(self.weights_of(rows), rows)
        return mean / max(float(np.linalg.norm(mean)), 1e-30)

    @cached_property
    def principal(self) -> Tensor:
        """[P, 3] f32 in 0..1, the features as colours."""
        from liftcore.query.splat_colours import principal_colours

        colours = principal_colours(self.features.rows, self.features.of_rows(self.total_weight))
        return colours if self.features.code is None else colours[self.features.code.astype(np.int64)]

    @cached_property
    def splat_file(self) -> Path:
        """The file of the splats that were lifted; of values in memory a temporary one; InvalidLift as `splats`."""
        if not self.metadata.splats.path and "splats" in self.__dict__:
            from liftcore.io.splats import write_splats

            folder = Path(mkdtemp(prefix="splatlift-"))
            finalize(self, rmtree, folder, ignore_errors=True)
            write_splats(folder / "splats.ply", self.splats)
            return folder / "splats.ply"
        path = self._verified_input("splats")
        self._require_rows(quick_count(path))
        return path

    def _require_rows(self, splats: int | None) -> None:
        """Raise InvalidLift if a lift of other rows would answer for other splats; ``splats`` None: not known yet."""
        if splats not in (None, len(self.features)):
            raise InvalidLift(
                str(self.path), expected=f"a row for each of its {splats} splats", got=f"{len(self.features)} rows",
                hint=TRANSFER,
            )  # fmt: skip

    @cached_property
    def splats(self) -> Splats:
        """The splats that were lifted; InvalidLift if their file moved or changed."""
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
        """All cameras of the scene, also those that the lift left out; InvalidLift if their file moved or changed."""
        from liftcore.io.cameras import read_cameras

        return read_cameras(self._verified_input("cameras"))

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
            InvalidQuery: its image is larger than pictures may be.
            InvalidLift: the cameras moved or changed since the lift.
        """
        from liftcore.scene.cameras import drawn_by

        camera = self.cameras[view] if isinstance(view, str) else view
        for width, height in (camera.photo_size, drawn_by(camera).photo_size):
            if width * height > MOST_PIXELS:
                raise InvalidQuery(
                    "view", expected=f"an image of at most {MOST_PIXELS} pixels to draw",
                    got=f"{width}x{height} in {camera.name!r}" + (", for its distorted photo" if camera.lens else ""),
                    hint="give the scene a camera of that pose with width, height, fx, fy, cx and cy divided alike",
                )  # fmt: skip
        return camera

    def image(self, view: str | Camera, draw: Callable[[Camera], Tensor]) -> Tensor:
        """Render an image [H, W, ..] of a view in its photo's pixels, by a function for pinholes (`in_photo`).

        Args:
            view: the name of a camera of the scene, or any camera in the frame of the splats.

        Raises:
            NotFound, InvalidQuery, InvalidLift: as `camera`.
        """
        from liftcore.scene.drawing import in_photo

        return in_photo(self.camera(view), draw)

    def strongest_labels(self, labels: np.ndarray, view: str | Camera) -> tuple[np.ndarray, np.ndarray]:
        """Render the splats' label [P] i32 with the most weight on each ray, [H, W] i32, and its row sum, [H, W] f32.

        Arguments and errors are those of `image`.
        """
        import torch

        values, params = torch.from_numpy(labels), self.compositing
        strongest = self.image(view, lambda camera: self.raster.strongest_labels(camera, values, params))
        return strongest.numpy(), self.image(view, lambda camera: self.raster.row_sums(camera, params)).numpy()

    def _verified_input(self, role: Literal["splats", "cameras"]) -> Path:
        """Return the path of an input whose bytes are those that were lifted; InvalidLift if there is none."""
        record: InputFile = getattr(self.metadata, role)
        if not record.path:
            raise InvalidLift(str(self.path), expected=f"a lift with a path of its {role}", got="values in memory",
                              hint=f"give the {role} that were lifted, {role}=")  # fmt: skip
        from liftcore.io.transforms import FRAME_FILE
        from liftcore.values.lift_file import found_input

        path, is_moved = Path(record.path), role in self._new_paths
        if role == "splats" and is_moved and not record.sha256 and path.exists():
            return path  # of values in memory, of which only the number is known
        verified_path = found_input(role, record, self.metadata, None if is_moved else self.path)
        if verified_path is not None:
            return verified_path
        option = f"say where they are with --{role} (in Python {role}=), or "
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
