"""What the columns of W stand for: rows of a codebook, or tuples of them.

A ray with labels on several levels gives each of its rows the same weight, so rays of one tuple of labels need one
column and not one a level: with ``c`` labelled levels it has c times the weight, and the mean of the c rows. That is
the same closed form, with half of the entries on real masks of four levels. Where a single region of a tuple counts
for itself (the robust steps, regions that the aggregation drops), columns are rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch.nn.functional import embedding_bag

from liftcore.features.levels import label_tuples
from liftcore.features.views import NO_LABEL, Regions, ViewFeatures

if TYPE_CHECKING:
    from collections.abc import Iterable

    from torch import Tensor

    from liftcore.raster.base import RegionWeights
    from liftcore.settings import LiftSettings


@dataclass(frozen=True)
class Columns:
    """The columns of one view's W."""

    codebook: Tensor  # E [M, F] f16 or f32
    tuples: Tensor | None = None  # [T, L] i32, the rows of a column, -1 none, at least one; None: column m is row m

    @property
    def count(self) -> int:
        """T, or M."""
        return (self.codebook if self.tuples is None else self.tuples).shape[0]

    def means(self, rows: Tensor) -> Tensor:
        """What the columns read: of some numbers of each row [M, C], the means [T, C] f32 over each tuple; without
        tuples the rows themselves, of their own type.

        Rows are divided before they are added: a mean cannot overflow where its inputs do not.
        """
        if self.tuples is None:
            return rows
        named = self.tuples != NO_LABEL
        shares = (named / named.sum(dim=1, keepdim=True)).to(rows.device)
        places = self.tuples.clamp_min(0).to(rows.device)  # of share zero where there is none
        means = embedding_bag(places, rows.float(), mode="sum", per_sample_weights=shares)
        largest = torch.finfo(torch.float32).max
        return means.clamp_(-largest, largest)  # the rounded shares of six rows add up to more than one

    def weighted(self, weights: RegionWeights) -> RegionWeights:
        """W by rays, whose columns are these, with each entry as often as its column has rows."""
        if self.tuples is None:
            return weights
        counts, place = (self.tuples != NO_LABEL).sum(dim=1).float(), weights.weights.device
        if place.type != "cpu":
            return replace(weights, weights=weights.weights * counts.to(place)[weights.columns])
        # By numpy: the threads that torch would take for this, and keep spinning, walk the next views.
        values = weights.weights.numpy() * counts.numpy()[weights.columns.numpy()]
        return replace(weights, weights=torch.from_numpy(values))


def rows_of(codebooks: Iterable[Tensor]) -> list[Columns]:
    """Columns that are the rows of every view's codebook."""
    return [Columns(book) for book in codebooks]


def by_rows(settings: LiftSettings) -> bool:
    """Whether single regions count for themselves."""
    return bool(settings.robust_steps or settings.aggregation_resolve)


def as_walked(observation: ViewFeatures, settings: LiftSettings) -> tuple[ViewFeatures, Columns]:
    """The observation for a walk, and the columns that its W has then."""
    return (observation, Columns(observation.codebook)) if by_rows(settings) else by_tuples(observation)


def warm_up_tuples() -> None:
    """Compile what numbers them, or load it from the disk cache."""
    by_tuples(Regions(torch.zeros(2, 1, 1, dtype=torch.int32), torch.zeros(1, 1)))


def by_tuples(observation: ViewFeatures) -> tuple[ViewFeatures, Columns]:
    """The observation for a walk, one level of tuples in place of several of rows, and its columns.

    Grids and single levels stay as they are, and maps of more than L tuples for each row of the codebook: strips of
    those would grow too much. The walk meets no channel, so what it is given has none.
    """
    columns = Columns(observation.codebook)
    if not isinstance(observation, Regions) or observation.labels.shape[0] == 1:
        return observation, columns
    most = observation.labels.shape[0] * columns.count
    labels = observation.labels.to(torch.int32).contiguous().numpy()
    numbers, tuples = label_tuples(labels)
    if not 0 < tuples.shape[0] <= most:
        return observation, columns
    regions = Regions.unchecked(torch.from_numpy(numbers)[None], observation.codebook.new_empty(tuples.shape[0], 0))
    return regions, replace(columns, tuples=torch.from_numpy(tuples))
