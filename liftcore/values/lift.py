"""What a lift gives: features on splats, what supports them, and how they were made.

Its metadata are read without torch, so that a question to a file loads none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict

from liftcore.scene.origin import FILE_ORIGIN, Origin
from liftcore.scene.views import composed
from liftcore.text.table import TableEncoder, own_words
from liftcore.values.settings import LiftSettings

if TYPE_CHECKING:
    import torch
    from torch import Tensor

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
    poses: str = ""  # of their cameras (`liftcore.values.lift_file.poses_of`); "" in older lifts
    origin: Origin = FILE_ORIGIN  # of the splats (`Splats.origin`), and of the positions in ``.splat`` and ``.spz``
    certificate: dict[str, Any]
    timings: dict[str, float]  # seconds a stage


@dataclass(frozen=True)
class Lift:
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
        return f"{type(self).__name__}({what}, preset={str(self.settings.preset)!r}, on {self.features.device})"

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
        return own_words(self.metadata.words, None if self.embeddings is None else self.embeddings.cpu().numpy())

    def to(self, place: torch.device) -> Self:
        """The same with its tensors there; where they are, if there is no room for them."""
        from liftcore.runtime.device import out_of_memory

        tensors = {name: part for name, part in vars(self).items() if name != "metadata" and part is not None}
        if all(part.device == place for part in tensors.values()):
            return self
        try:
            return replace(self, **{name: part.to(place) for name, part in tensors.items()})
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
            return self

    def cpu(self) -> Self:
        """The same with its tensors on the CPU."""
        import torch

        return self.to(torch.device("cpu"))
