"""E of all views: the vectors of the regions of W, rows of codebooks or means of several rows.

A ray with labels on several levels gives each of its rows the same weight, so rays with one tuple of labels need one
region, not one per level: with ``c`` labelled levels it has c times the weight, and the mean of the c rows. That is
the same closed form, with half of the entries on real masks of four levels. Where single regions of a tuple matter
(reweighting, regions that the aggregation drops), regions are rows.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from liftcore.solve.shared_rows import new_table
from liftcore.values.levels import label_tuples
from liftcore.values.region_weights import RegionWeights
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

ROWS = 1 << 10  # of a codebook that are converted at a time
FLOAT16_MAX = 65_504.0
FLOAT16_STEP = 2.0**-25  # the largest rounding error of its small values
FLOAT16_ERROR = 1e-4  # of the longest vector, the largest error of a row in float16
TABLE_BYTES = 1 << 28  # of float32 columns of E of all views at a time
LEAST_CHANNELS = 8  # at a time, for any number of regions


@dataclass(frozen=True)
class ViewCodebook:
    """The vectors of the regions of one view's W."""

    rows: Tensor  # E [M, F] f16 or f32
    tuples: Tensor | None = None  # [T, L] i32, the rows of a region, -1 none, at least one; None: region m is row m

    @property
    def regions(self) -> int:
        """The number of regions, T or M."""
        return (self.rows if self.tuples is None else self.tuples).shape[0]

    def means(self, rows: Tensor) -> Tensor:
        """Return the means [T, C] of values of the rows [M, C] f32 over each tuple, or the rows themselves.

        Rows are divided before they are added: a mean cannot overflow if its inputs do not.
        """
        if self.tuples is None:
            return rows
        has_row = self.tuples != NO_LABEL
        shares = has_row.float() / has_row.sum(dim=1, keepdim=True)  # zero where a tuple has no row
        means = embedding_bag(self.tuples.clamp_min(0), rows, mode="sum", per_sample_weights=shares)
        largest = torch.finfo(torch.float32).max
        return means.clamp_(-largest, largest)  # the rounded shares of six rows add up to more than one

    def weights_by_row(self, weights: RegionWeights) -> RegionWeights:
        """Return W with each entry multiplied by the number of rows of its region."""
        if self.tuples is None:
            return weights
        counts = (self.tuples != NO_LABEL).sum(dim=1).float()
        return replace(weights, weight=weights.weight * counts[weights.region])


@dataclass(frozen=True)
class Codebook:
    """E of all views, concatenated in the order of the offsets of W."""

    views: Sequence[ViewCodebook]

    @property
    def channels(self) -> int:
        """The number of channels, F."""
        return self.views[0].rows.shape[1]

    @property
    def regions(self) -> int:
        """The number of regions of all views, M."""
        return sum(view.regions for view in self.views)

    @cached_property
    def lengths(self) -> list[Tensor]:
        """The lengths of the rows of each view's codebook, [M] f64 per view."""
        return [row_lengths(view.rows) for view in self.views]

    def fits_float16(self) -> bool:
        """Return True if float16 represents every value, and all rows to FLOAT16_ERROR of the longest."""
        longest = 0.0
        for view, lengths in zip(self.views, self.lengths, strict=True):
            if view.rows.numel():
                if max(abs(float(end)) for end in torch.aminmax(view.rows)) > FLOAT16_MAX:
                    return False
                longest = max(longest, float(lengths.max()))
        return longest == 0 or FLOAT16_STEP * math.sqrt(self.channels) <= FLOAT16_ERROR * longest

    def slices(self) -> Iterator[slice]:
        """Return the slices of channels for `values`, such that a table takes TABLE_BYTES."""
        step = max(LEAST_CHANNELS, TABLE_BYTES // (4 * max(self.regions, 1)))
        return (slice(begin, min(begin + step, self.channels)) for begin in range(0, self.channels, step))

    def values(self, channels: slice) -> Tensor:
        """Return some channels of the vectors of all regions, [M, C] f32."""
        return self._table(channels, lambda _, rows: rows.float())

    def unit_values(self, channels: slice) -> Tensor:
        """Return some channels of all vectors, from rows of unit length, [M, C] f32; zero rows stay zero."""

        def unit_rows(view: int, rows: Tensor) -> Tensor:
            lengths = self.lengths[view]
            return (rows.double() / torch.where(lengths > 0, lengths, 1.0)[:, None]).float()

        return self._table(channels, unit_rows)

    def _table(self, channels: slice, of_rows: Callable[[int, Tensor], Tensor]) -> Tensor:
        table, base = new_table(self.regions, channels.stop - channels.start), 0
        for number, view in enumerate(self.views):
            table[base : base + view.regions] = view.means(of_rows(number, view.rows[:, channels]))
            base += view.regions
        return table


def as_regions(observation: ViewFeatures, by_rows: bool) -> tuple[ViewFeatures, ViewCodebook]:
    """Return the observation for the raster, and the codebook of the regions of its W.

    Several levels of rows become one level of tuples, unless ``by_rows``. Grids and single levels stay unchanged, and
    so do maps with more than L tuples per row of the codebook, whose tables would grow too much. The raster reads no
    channels, so the observation of tuples has none.
    """
    codebook = ViewCodebook(observation.codebook)
    if by_rows or not isinstance(observation, Regions) or observation.labels.shape[0] == 1:
        return observation, codebook
    numbers, tuples = label_tuples(observation.labels.contiguous().numpy())
    if not 0 < tuples.shape[0] <= observation.labels.shape[0] * codebook.regions:
        return observation, codebook
    regions = Regions.unchecked(torch.from_numpy(numbers)[None], observation.codebook.new_empty(tuples.shape[0], 0))
    return regions, replace(codebook, tuples=torch.from_numpy(tuples))


def row_lengths(rows: Tensor) -> Tensor:
    """Return lengths [M] f64 of vectors [M, F] f16 or f32, in blocks, as all in float64 would take much memory."""
    parts = [
        torch.linalg.vector_norm(part.float(), dim=1, dtype=torch.float64)  # faster than .double()
        for part in rows.split(ROWS)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.float64)
