"""How the field measures open-vocabulary segmentation: three protocols whose numbers cannot be compared, and our own.

- P1 (LangSplat): features are rendered, a relevancy map is made in 2D and cut at 0.4. Localised when its peak lies in
  a box of the object.
- P2 (OpenGaussian): splats are selected in 3D and their silhouette is rendered alone. Localised at an IoU of at least
  0.25 (and 0.5).
- P3 (LaGa, Splat Feature Solver): splats are scored in 3D, scores are rendered and cut in 2D. Localised when the peak
  of the map lies in the object's mask.
- own: splats are selected in 3D, and a mask is where they are at least half of a ray, as a query makes it.
  Localised as P2 is.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np

Box = tuple[int, int, int, int]  # x1 y1 x2 y2, pixels, both ends inside


class EvaluationProtocol(StrEnum):
    """Which way a number was measured."""

    P1 = "P1"
    P2 = "P2"
    P3 = "P3"
    OWN = "own"


@dataclass(frozen=True)
class LabelledObject:
    """What is really there: all that one category covers in a frame."""

    category: str  # the text that is asked
    mask: np.ndarray  # [H, W] bool, at the camera's size
    boxes: tuple[Box, ...]  # one a polygon


@dataclass(frozen=True)
class Prediction:
    """What a protocol finds for a text in a view."""

    mask: np.ndarray  # [H, W] bool
    peak: tuple[int, int] | None  # x y of the highest value; None where the protocol has no such pixel


class LabelledScene(Protocol):
    """The ground truth of one scene."""

    @property
    def name(self) -> str:
        """The scene."""
        ...

    @property
    def views(self) -> tuple[str, ...]:
        """The labelled frames, by view name."""
        ...

    def objects(self, view: str, width: int, height: int) -> list[LabelledObject]:
        """The objects of a frame at the size of its camera [pixels]; a category stands once, and may be empty.

        Raises:
            InvalidInput: the labels are malformed.
        """
        ...


class Segmenter(Protocol):
    """One protocol at work on one lift, for fixed texts."""

    def look(self, view: str) -> dict[str, Prediction]:
        """What each text finds in a view."""
        ...
