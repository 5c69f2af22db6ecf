"""Scene, a lift opened for queries: the library's face of all queries of the command line and the service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from liftcore.errors import InvalidLift
from liftcore.query.opened import OpenedLift
from liftcore.runtime.progress import Progress, shown_progress

if TYPE_CHECKING:  # these load torch
    import numpy as np
    from PIL.Image import Image

    from liftcore.io.labels import Labels
    from liftcore.query.ask import ResolvedQuery
    from liftcore.query.catalogue import Catalogue
    from liftcore.query.question import (
        Answer,
        BestWord,
        Objects,
        Query,
        SceneTree,
        SuggestedWords,
    )
    from liftcore.query.render import ViewMask
    from liftcore.query.segment import Segmentation
    from liftcore.query.selections import Selection
    from liftcore.query.terms import Example
    from liftcore.scene.cameras import Camera
    from liftcore.scene.kernel import Kernel
    from liftcore.text import TextEncoder

Source: TypeAlias = (  # of a file
    "Query | str | Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree | np.ndarray | int | None"
)


class Scene(OpenedLift):
    """A lift opened for queries, with the splats and cameras of its scene.

    Norms, mean, axes and encoders are computed once and cached. Scores need the lift alone, and no torch. Splats,
    cameras and packs that are not passed are read from the paths in the lift, once and at first use, and verified by
    their digests.

    Args:
        source: the lift, or the path of its file, which is mapped and not read.
        splats: that were lifted, or their new path if they moved. cameras: of the scene, or their path.
        packs: that were lifted.
        world: up axis and length unit, if the lift has none, or wrong ones.

    Raises:
        InvalidLift: the file is missing, is not a lift, or has other rows than the file of ``splats``, if these can
            be counted without reading them.
        InvalidSplats: other splats than were lifted (`Lift.require_splats`).
    """

    selections: dict[str, Selection]
    """selections by their names (`select`)"""

    def __repr__(self) -> str:
        objects = "" if self.object_views is None else f", {len(self.object_views)} objects"
        return f"Scene({len(self.features)} splats, {self.channels} channels{objects})"

    def ask(
        self, query: Query | str, *, encoder: TextEncoder | str | Path | None = None, places: bool | None = None
    ) -> Answer:
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
            NotFound: an example names a view or a region that does not exist.
            InvalidLift: an example or ``places`` need the scene's files, and they moved or changed.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import ask, locate
        from liftcore.query.question import Query

        query = Query.of(query) if isinstance(query, str) else query
        needs_encoder = bool(query.texts) or encoder is not None
        answer = ask(self, query, self.encoder(encoder) if needs_encoder else None)
        if places is False:
            return answer
        with nullcontext() if places else suppress(InvalidLift):
            return locate(self, answer)
        return answer

    def prepare(self, query: Query, encoder: TextEncoder | None = None) -> ResolvedQuery:
        """Resolve a query's terms to directions, and raise all of its errors; arguments as in `ask`."""
        from liftcore.query.ask import resolve_query

        return resolve_query(self, query, encoder, query.places)

    def answer(self, questions: Sequence[ResolvedQuery]) -> list[Answer]:
        """Answer prepared queries in one pass over the features; each to the same bits as alone (`ask`)."""
        from liftcore.query.ask import answers

        return answers(self, questions)

    def locate(self, answer: Answer, count: int | None = None) -> Answer:
        """Add to an answer its best splats and the box of its selection (`liftcore.query.ask.locate`)."""
        from liftcore.query.ask import locate

        return locate(self, answer, count)

    def best_view(self, answer: Answer) -> str | None:
        """Return the view that shows most of the object with the most selected splats, or else the first view."""
        from liftcore.query.ask import best_view

        return best_view(self, answer)

    def view_mask(
        self,
        query: Query | str | Answer,
        view: str | Camera | None = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
        find_objects: Callable[[], Objects] | None = None,
    ) -> ViewMask:
        """Render an answer from a camera: its attention, and a mask of the objects that were found.

        Args:
            query: as in `ask`, or the answer to it. view: the name of a camera of the scene, or any camera in the
                frame of the splats; None: the query's own.
            find_objects: returns the answer's objects, such as cached ones; None: `objects`.

        Raises:
            InvalidQuery, NotFound, InvalidLift, Unavailable: as `ask` and `liftcore.query.render.view_mask`.
        """
        from liftcore.query.render import view_mask

        answer = self._answer(query, encoder)
        group = (lambda *_: self.objects(answer)) if find_objects is None else lambda *_: find_objects()
        return view_mask(self, answer, answer.query.seen_from() if view is None else view, group)

    def mask(
        self,
        query: Query | str | Answer,
        view: str | Camera | None = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> np.ndarray:
        """Return the pixels of a view with the answer's objects, [H, W] bool; arguments as in `view_mask`."""
        return self.view_mask(query, view, encoder=encoder).mask

    def attention(
        self,
        query: Query | str | Answer,
        view: str | Camera | None = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> np.ndarray:
        """Render the scores of a view, [H, W] f32; arguments as in `view_mask`."""
        return self.view_mask(query, view, encoder=encoder).attention

    def select(self, name: str, source: Answer | Query | str | np.ndarray | int | None = None) -> Selection:
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
        from liftcore.query.render import expected_depth, render

        scene = self.without(hide)
        return expected_depth(scene, view)[0] if channel == "depth" else render(scene, view, channel)

    def objects(self, query: Query | str | Answer, *, encoder: TextEncoder | str | Path | None = None) -> Objects:
        """Group the splats of an answer to objects of touching splats with boxes (`liftcore.query.objects`)."""
        from liftcore.query.objects import objects

        return objects(self, self._answer(query, encoder))

    def catalogue(
        self, words: Sequence[str] = (), vectors: Any = None, *, encoder: TextEncoder | str | Path | None = None
    ) -> Catalogue:
        """List the objects on which masks of many views agree, found at lift time; words name them.

        Args:
            words: n. vectors: [n, F], torch or numpy, their text vectors, of any length above zero. None: the encoder
                computes them.
        """
        from liftcore.query.catalogue import catalogue

        if words and vectors is None:
            vectors = self.encoder(encoder).encode(words)
        return catalogue(self, words, vectors)

    def tree(
        self,
        words: Sequence[str] = (),
        vectors: Any = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> SceneTree:
        """List the objects of `catalogue` with their parts and groups of them: a node's parts are nodes, too.

        Args:
            words, vectors, encoder: as in `catalogue`.
        """
        from liftcore.query.catalogue import tree

        if words and vectors is None:
            vectors = self.encoder(encoder).encode(words)
        return tree(self, words, vectors)

    def segment(
        self,
        words: Sequence[str] | None = None,
        vectors: Any = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
        progress: Progress | bool | None = False,
    ) -> Segmentation:
        """Label every splat with the most similar word, or none (`liftcore.query.segment`).

        Args:
            words: n different ones; None: all words of the encoder, which is a table. vectors: as in `catalogue`.
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
        encoder: TextEncoder | str | Path | None = None,
    ) -> tuple[BestWord, ...]:
        """Return the words most similar to an example, the nearest first.

        Args:
            example: or its notation, as in `Query.like`, or a vector [F].
            words: None: all words of the encoder, which is a table.
        """
        from liftcore.query.segment import best_words
        from liftcore.query.terms import Vector, parse_example

        reader = self.encoder(encoder)
        words = self.words(reader) if words is None else words
        if isinstance(example, str):
            example = parse_example(example, "example")
        elif isinstance(example, Sequence):
            example = Vector(tuple(example))
        return best_words(self, example, words, reader.encode(words), top)

    def words(self, encoder: TextEncoder | str | Path | None = None) -> list[str]:
        """Return all words of an encoder that is a table, each once; another encoder is an InvalidQuery."""
        from liftcore.query.segment import words_of

        return words_of(self.encoder(encoder))

    def askable(
        self, text: str = "", count: int = 8, *, encoder: TextEncoder | str | Path | None = None
    ) -> SuggestedWords:
        """Suggest at most ``count`` words that complete a text, and words of the lift's objects.

        Raises:
            InvalidQuery: the lift's text space names no encoder.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.directions import askable_words

        return askable_words(self, self.encoder(encoder), text, count)

    def colours(self, what: str) -> np.ndarray:
        """Return [P, 3] u8 sRGB of splats by a layer.

        Args:
            what: pca, cluster, total_weight or confidence.

        Raises:
            InvalidQuery: the lift has no such layer.
        """
        from liftcore.query.export import layer_colours

        return layer_colours(self, what)

    def labels(self, source: Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree) -> Labels:
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

    def export(self, path: Path | str, source: Source = None, what: str = "", **options: Any) -> None:
        """Write a file, whole or not at all; arguments and errors as in `blocks_of`, with the suffix of the path."""
        from liftcore.io.files import whole_file

        options = {"suffix": Path(path).suffix.lower(), **options}
        content = self.blocks_of(source, what, **options)
        with whole_file(Path(path)) as handle:
            handle.writelines(content)

    def blocks_of(
        self,
        source: Source = None,
        what: str = "",
        *,
        view: str | Camera | None = None,
        suffix: str = "",
        view_mask: ViewMask | None = None,
        photo: Image | None = None,
        encoder: TextEncoder | str | Path | None = None,
    ) -> Iterable[bytes]:
        """Make a file, in blocks.

        Args:
            source: a query or its answer, answers by names, a segmentation, a catalogue or a tree, the id of an
                object or another node, or an array; None: the scene.
            what: of an answer object, coloured, scores, selection, mask, attention or overlay; of a segmentation
                coloured, labels, picture or splat_labels; of a catalogue csv; of all these and of a tree labelled
                (splats with labels), names (of the labels) or masks (COCO's JSON, in the views); of the scene a
                channel of `render`, or splats; of an array npy, or mask of booleans [H, W]. Empty: the first of
                these; of a segmentation or a catalogue as a .glb or .usdz labelled (a catalogue as a .ply, too),
                .json masks.
            view: of pictures, as in `view_mask`; of masks the name of the only one.
            suffix: of its name, where there are several formats.
            view_mask: the answer's mask in the view, if it is cached. photo: of the view, for an overlay.

        Raises:
            InvalidQuery: there is no such file of the source, or the file would be empty.
            NotFound, InvalidLift, Unavailable: as the query, or as `render`.
        """
        import numpy as np

        from liftcore.query.export import array_blocks, blocks_of
        from liftcore.query.question import Query

        if isinstance(source, np.ndarray):
            return array_blocks(source, what)
        source = self._answer(source, encoder) if isinstance(source, str | Query) else source
        return blocks_of(self, source, what, view=view, suffix=suffix, view_mask=view_mask, photo=photo)

    def _answer(self, query: Query | str | Answer, encoder: TextEncoder | str | Path | None) -> Answer:
        from liftcore.query.question import Answer

        return query if isinstance(query, Answer) else self.ask(query, encoder=encoder, places=False)
