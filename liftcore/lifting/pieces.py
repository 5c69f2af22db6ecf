"""W of a lift in pieces, and the arrays that its steps make; in memory all of W is one piece.

A step (`liftcore.lifting.steps`) works on a piece of views, which has all splats of their regions, or on a block of
splats, which has all their views. It loads the arrays of earlier steps and saves its own, by the name of the step and
the number of the piece; tables of the whole scene have no number. `lifting.engines.blocks` has them in files.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.sums import PieceSums, sum_pieces

if TYPE_CHECKING:
    from liftcore.solve.codebook import Codebook
    from liftcore.solve.directions import RegionDirections
    from liftcore.solve.rays import SampledRays
    from liftcore.values.settings import LiftSettings

Shape = tuple[int, int]  # of a table of sums


@dataclass(frozen=True, kw_only=True)
class Pieces(ABC):
    """The pieces of a lift, as each step receives them."""

    settings: LiftSettings
    names: tuple[str, ...]  # of the views, in the order of the sums
    splats: int  # P
    channels: int  # F
    dtype: torch.dtype = torch.float16  # of X
    turn: int = 0  # of a step that runs several times
    usual_share: float | None = None  # the mean share of mask consensus; None where there is none
    levels_apart: bool = False  # True if regions are compared with those of their own level alone
    view_pieces: int = 1
    rows: int = 0  # of a block of splats: pieces of sums; 0: all of them

    @property
    def splat_pieces(self) -> int:
        """The number of blocks of splats."""
        return -(-self.splats // self.rows) if self.rows else 1

    def views_of(self, _piece: int) -> range:
        """Return the numbers of the views of a piece."""
        return range(len(self.names))

    def bounds(self, piece: int) -> tuple[int, int]:
        """Return the first splat of a block, and that after its last."""
        rows = self.rows or self.splats
        return piece * rows, min((piece + 1) * rows, self.splats)

    @property
    @abstractmethod
    def means(self) -> Tensor:
        """[P, 3], of the splats."""

    @property
    @abstractmethod
    def codebook(self) -> Codebook:
        """E of all views."""

    @abstractmethod
    def has(self, step: str, number: int) -> bool:
        """Return True if a piece of a step is done."""

    @abstractmethod
    def load(self, step: str, number: int | None = None) -> dict[str, Any]:
        """Return the arrays of a piece by name, or those of a table."""

    @abstractmethod
    def save(
        self,
        step: str,
        number: int | None,
        arrays: dict[str, Any],
        sums: Iterable[PieceSums] = (),
        shape: Shape | None = None,
    ) -> None:
        """Store arrays or tensors, and sums by pieces of splats, which are read first.

        Args:
            shape: of the table of the sums; None if it would be too large.
        """

    @abstractmethod
    def sums(self, step: str) -> Iterable[PieceSums]:
        """Iterate over the sums of all pieces of a step, in order."""

    @abstractmethod
    def drop(self, *steps: str) -> None:
        """Free the memory of steps that are read no more."""

    @abstractmethod
    def writable(self, array: np.ndarray) -> Tensor:
        """Return the values of a loaded array, to be overwritten."""

    @abstractmethod
    def keep_directions(self, directions: RegionDirections) -> None:
        """Store the directions of all regions."""

    @abstractmethod
    def directions(self) -> RegionDirections:
        """Return what `keep_directions` stored."""

    @abstractmethod
    def new_features(self, piece: int) -> Tensor:
        """Return zeros for X of a block of splats."""

    @abstractmethod
    def save_features(self, piece: int, X: Tensor) -> None:
        """Store X of a block."""

    @abstractmethod
    def features(self) -> Tensor:
        """Return X of all blocks, [P, F]."""

    @abstractmethod
    def samples(self) -> Sequence[SampledRays]:
        """Return the sampled rays of each view."""

    def table(self, step: str, shape: Shape) -> np.ndarray:
        """Add up the sums of a step over all splats."""
        return sum_pieces(self.sums(step), shape)

    def column(self, step: str, name: str) -> np.ndarray:
        """Return a column of all splats [P] from the blocks of a step."""
        return np.concatenate([self.load(step, number)[name] for number in range(self.splat_pieces)])
