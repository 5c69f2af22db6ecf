"""What a lift gives: features on splats, what supports them, and how they were made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict

from liftcore.scene.views import composed
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import torch
    from torch import Tensor

    from liftcore.query.ask import VectorAnswer
    from liftcore.query.catalogue import Catalogue
    from liftcore.query.segment import Segmentation
    from liftcore.query.text import TextEncoder
    from liftcore.query.text.table import TableEncoder
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

FORMAT = "splatlift-lift/1"


class InputFile(BaseModel):
    """Where an input was, and what it was."""

    model_config = ConfigDict(frozen=True)

    path: str  # absolute, at lift time; empty for values that came from no file
    sha256: str  # of the file's bytes; of the sorted (name, digest) lines for a folder


NO_FILE = InputFile(path="", sha256="")


class LiftMetadata(BaseModel):
    """What a lift remembers of how it was made."""

    model_config = ConfigDict(frozen=True)

    format: str = FORMAT
    version: str
    settings: LiftSettings
    splats: InputFile = NO_FILE
    cameras: InputFile = NO_FILE
    features: tuple[InputFile, ...] = ()
    encoder: str = ""  # the 2D encoder's name as the pack tells it; "" when unknown
    text_space: str = ""  # the text encoder that shares the space; "" not named, "none" when there is none
    words: tuple[str, ...] = ()  # that its packs brought: it is asked in these without an encoder
    views: tuple[Annotated[str, AfterValidator(composed)], ...]  # the views that were lifted
    poses: str = ""  # of their cameras (`liftcore.io.lift_file.poses_of`); "" in older lifts
    certificate: dict[str, Any]
    timings: dict[str, float]  # seconds a stage


@dataclass(frozen=True)
class LiftResult:
    """X and what supports it, one row a splat, in the splats' order."""

    features: Tensor  # [P, F] f16 or f32; zero rows where not seen
    evidence: Tensor  # [P] f32, sum of plain weights w over the feature views, each ray once
    agreement: Tensor  # [P] f32 in 0..1, norm of the mean of unit regions or cells; says little of being right
    seen: Tensor  # [P] bool, whether any labelled ray reached the splat
    metadata: LiftMetadata
    confidence: Tensor | None = None  # [P] f32 in 0..1, how far views say the same; None: not reweighted
    cluster: Tensor | None = None  # [P] i32, -1 = in no cluster; None without aggregation
    cluster_features: Tensor | None = None  # [K, F] like features; a zero row: its splats keep their own
    embeddings: Tensor | None = None  # [n, F] f32, the unit vectors of the metadata's words; None: it has none
    object: Tensor | None = None  # [P] i32, -1 = of no object; None: objects were not looked for
    object_views: Tensor | None = None  # [N, 5] i32, places in ``views`` that show most of each, -1 after the last

    def __repr__(self) -> str:
        splats, channels = self.features.shape
        what = f"{splats} splats, {channels} channels from {len(self.views)} views"
        return f"LiftResult({what}, preset={str(self.settings.preset)!r}, on {self.features.device})"

    @property
    def settings(self) -> LiftSettings:
        """What the lift was made with."""
        return self.metadata.settings

    @property
    def views(self) -> tuple[str, ...]:
        """The names of the views that were lifted, in the order of the sums."""
        return self.metadata.views

    @property
    def diagnostics(self) -> dict[str, Any]:
        """What the lift measured of itself (residual, bound, row sums, warnings, plan), as plain numbers."""
        return self.metadata.certificate

    @property
    def table(self) -> TableEncoder | None:
        """The words that its packs brought, with their vectors (`.words`, `.encode(words)`); None without any."""
        from liftcore.query.text.table import own_words

        return own_words(self.metadata.words, None if self.embeddings is None else self.embeddings.cpu().numpy())

    def to(self, place: torch.device) -> LiftResult:
        """The same with its tensors there; where they are, if there is no room for them."""
        from liftcore.device import out_of_memory

        tensors = {name: part for name, part in vars(self).items() if name != "metadata" and part is not None}
        if all(part.device == place for part in tensors.values()):
            return self
        try:
            return replace(self, **{name: part.to(place) for name, part in tensors.items()})
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
            return self

    def cpu(self) -> LiftResult:
        """The same with its tensors on the CPU."""
        import torch

        return self.to(torch.device("cpu"))

    def query(
        self,
        positives: Any,
        negatives: Any = (),
        *,
        splats: Splats | None = None,
        threshold: str | float = "auto",
        instances: int | None = None,
        keep: str = "all",
        absent: str = "drop",
        weigh: str = "evidence",
        references: Any = None,
        encoder: TextEncoder | str | Path | None = None,
    ) -> VectorAnswer:
        """Which splats answer words, or vectors of the lift's text space.

        Args:
            positives: a text or several, or [n, F] or [F], torch or numpy: what is looked for; rows of any length
                above zero.
            negatives: the same, what takes away from the scores.
            splats: that were lifted; with them the answer has objects with boxes.
            threshold: auto, valley, paper, otsu, stability or a number on the scores.
            instances: how many things there are, where the caller knows. keep: of the objects, all or the largest.
            absent: drop what is not there, so that nothing is selected, or keep what is most like it.
            weigh: what splats count by in the threshold's histogram and in objects: evidence, or that times
                `confidence`.
            references: [n, F], the vectors of 200 words or more, by which presence is known; None = those of the
                lift's text space, where it has some.
            encoder: of texts and of reference words, or the specification of one (`liftcore.open_encoder`). None: the
                lift's own words (`table`), else the encoder of its text space, opened for this question (give one for
                many), or the table of it that ships, where its weights cannot be had.

        Raises:
            InvalidQuery: a vector of another length, of zeros or not finite; a text that the encoder cannot read, or
                no encoder of the lift's text space; or an unknown threshold.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import query_vectors

        return query_vectors(
            self, positives, negatives, splats=splats, threshold=threshold, instances=instances, keep=keep,
            absent=absent, weigh=weigh, references=references, encoder=encoder,
        )  # fmt: skip

    def segment(
        self,
        words: Sequence[str],
        vectors: Any = None,
        splats: Splats | None = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> Segmentation:
        """Name every splat by the word that it is most like, or by none (`liftcore.query.segment`).

        Args:
            words: n different ones. vectors: [n, F], torch or numpy, their text vectors, of any length above zero.
                None: the encoder makes them.
            splats: that were lifted; may be left out where the lift was made of files that are where they were.
            encoder: as in `query`.

        Raises:
            InvalidQuery: no words, one word twice, vectors that are no directions of the lift's space, a word that
                the encoder cannot read, or no encoder of the space.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import encoder_for
        from liftcore.query.presence import references_of
        from liftcore.query.scene import QueryScene
        from liftcore.query.segment import segment

        scene, references = QueryScene(self.cpu(), splats), None
        if vectors is None:
            encoder = encoder_for(scene, encoder)
            vectors, references = encoder.encode(words), references_of(encoder, scene.metadata.text_space)
        return segment(scene, words, vectors, references=references)

    def objects(
        self,
        splats: Splats | None = None,
        words: Sequence[str] = (),
        vectors: Any = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> Catalogue:
        """The objects that masks of many views agree on, found at lift time without a word; the largest first.

        Args:
            splats: that were lifted; may be left out where the lift was made of files that are where they were.
            words: n, that objects are named by. vectors: [n, F], torch or numpy, their text vectors, of any length
                above zero. None: the encoder makes them.
            encoder: as in `query`.

        Raises:
            InvalidQuery: vectors that are no directions of the lift's space, a word that the encoder cannot read, or
                no encoder of the space.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import encoder_for
        from liftcore.query.catalogue import catalogue
        from liftcore.query.scene import QueryScene

        scene = QueryScene(self.cpu(), splats)
        if words and vectors is None:
            vectors = encoder_for(scene, encoder).encode(words)
        return catalogue(scene, words, vectors)

    def save(self, path: Path | str) -> None:
        """Write a lift file (`liftcore.io.lift_file`), whole or not at all."""
        from liftcore.io.lift_file import save_lift

        save_lift(self, path)

    def show(
        self,
        splats: Splats | None = None,
        cameras: Mapping[str, Camera] | None = None,
        *,
        port: int = 0,
        browser: bool = True,
    ) -> None:
        """Show it on the service's page at a port of this machine, until Ctrl-C or a notebook's interrupt.

        Args:
            splats: that were lifted. cameras: of its views. Both may be left out where the lift was made of files
                that are where they were.
            port: 0 picks a free one. browser: whether to open one; the address is printed.

        Raises:
            InvalidInput: splats or cameras that it needs are not given, or not those of the lift.
            Unavailable: the package ``service`` is not installed.
        """
        from liftcore.page import show

        show(self, splats, cameras, port=port, browser=browser)
