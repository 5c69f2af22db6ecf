"""E of all views: what the regions of W stand for, rows of codebooks or means of several rows.

A ray with labels on several levels gives each of its rows the same weight, so rays of one tuple of labels need one
region and not one a level: with ``c`` labelled levels it has c times the weight, and the mean of the c rows. That is
the same closed form, with half of the entries on real masks of four levels. Where a single region of a tuple counts
for itself (reweighting, regions that the aggregation drops), regions are rows.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from liftcore.solve.shared_rows import new_table
from liftcore.values.levels import label_tuples
from liftcore.values.region_weights import RegionWeights
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

ROWS = 1 << 10  # of a codebook that are widened at a time
FLOAT16_MAX = 65_504.0
FLOAT16_STEP = 2.0**-25  # the largest rounding error of its small values
FLOAT16_ERROR = 1e-4  # of the longest vector, which float16 must hold
UNIT_TOLERANCE = 5e-3  # float16 unit vectors are off by less
SHORTEST = 1e-30  # of the vectors whose inverse length float32 takes well
TABLE_BYTES = 1 << 28  # of float32 columns of E of all views at a time
LEAST_CHANNELS = 8  # at a time, however many regions there are


@dataclass(frozen=True)
class ViewCodebook:
    """What the regions of one view's W stand for."""

    rows: Tensor  # E [M, F] f16 or f32
    tuples: Tensor | None = None  # [T, L] i32, the rows of a region, -1 none, at least one; None: region m is row m

    @property
    def regions(self) -> int:
        """T, or M."""
        return (self.rows if self.tuples is None else self.tuples).shape[0]

    def means(self, rows: Tensor) -> Tensor:
        """Of some numbers of each row [M, C] f32, what the regions read: means [T, C] over each tuple, or the rows.

        Rows are divided before they are added: a mean cannot overflow where its inputs do not.
        """
        if self.tuples is None:
            return rows
        tuples = self.tuples.to(rows.device)
        named = tuples != NO_LABEL
        shares = named.float() / named.sum(dim=1, keepdim=True)  # zero where a tuple names none
        means = embedding_bag(tuples.clamp_min(0), rows, mode="sum", per_sample_weights=shares)
        largest = torch.finfo(torch.float32).max
        return means.clamp_(-largest, largest)  # the rounded shares of six rows add up to more than one

    def counted(self, weights: RegionWeights) -> RegionWeights:
        """W by rays, with each entry as often as its region has rows."""
        if self.tuples is None:
            return weights
        counts = (self.tuples != NO_LABEL).sum(dim=1).float().to(weights.device)
        return replace(weights, weight=weights.weight * counts[weights.region])


@dataclass(frozen=True)
class Codebook:
    """E of all views, one after the other, as the offsets of W number its regions."""

    views: Sequence[ViewCodebook]

    @property
    def channels(self) -> int:
        """F."""
        return self.views[0].rows.shape[1]

    @property
    def regions(self) -> int:
        """M, of all views."""
        return sum(view.regions for view in self.views)

    @cached_property
    def lengths(self) -> list[Tensor]:
        """[M] f64 a view: of the rows of its codebook."""
        return [row_lengths(view.rows) for view in self.views]

    @cached_property
    def unit(self) -> bool:
        """Whether all rows are unit vectors, as float16 has them."""
        return all(bool(((length - 1).abs() < UNIT_TOLERANCE).all()) for length in self.lengths)

    @cached_property
    def inverse_lengths(self) -> Tensor | None:
        """[M] f32, what makes a unit vector of what each region reads, zero for none.

        None where a region reads the mean of several rows, or float32 does not hold its product with a weight.
        """
        lengths = torch.cat(self.lengths)
        known = lengths > 0
        if any(view.tuples is not None for view in self.views) or bool((lengths[known] < SHORTEST).any()):
            return None
        return torch.where(known, 1.0 / lengths, 0.0).float()

    def fits_float16(self) -> bool:
        """Whether float16 holds what the rows are."""
        return float16_holds(((view.rows, own) for view, own in zip(self.views, self.lengths, strict=True)))

    def slices(self) -> Iterator[slice]:
        """The channels that `values` gives at a time, so that a table takes TABLE_BYTES."""
        step = max(LEAST_CHANNELS, TABLE_BYTES // (4 * max(self.regions, 1)))
        return (slice(begin, min(begin + step, self.channels)) for begin in range(0, self.channels, step))

    def values(self, channels: slice, place: torch.device) -> Tensor:
        """Some channels of what all regions read, [M, C] f32."""
        return self._table(channels, place, lambda _, rows: rows.float())

    def unit_values(self, channels: slice, place: torch.device) -> Tensor:
        """Some channels of the same of unit vectors [M, C] f32; vectors of zeros stay."""

        def divided(view: int, rows: Tensor) -> Tensor:
            lengths = self.lengths[view].to(place)
            return (rows.double() / torch.where(lengths > 0, lengths, 1.0)[:, None]).float()

        return self._table(channels, place, divided)

    def _table(self, channels: slice, place: torch.device, of_rows: Callable[[int, Tensor], Tensor]) -> Tensor:
        table, base = new_table(self.regions, channels.stop - channels.start, place), 0
        for number, view in enumerate(self.views):
            table[base : base + view.regions] = view.means(of_rows(number, view.rows[:, channels].to(place)))
            base += view.regions
        return table


def as_regions(observation: ViewFeatures, by_rows: bool) -> tuple[ViewFeatures, ViewCodebook]:
    """The observation for the raster, and what the regions of its W stand for then.

    One level of tuples in place of several of rows, unless ``by_rows``. Grids and single levels stay as they are, and
    maps of more than L tuples for each row of the codebook: tables of those would grow too much. The raster meets no
    channel, so what it is given has none.
    """
    codebook = ViewCodebook(observation.codebook)
    if by_rows or not isinstance(observation, Regions) or observation.labels.shape[0] == 1:
        return observation, codebook
    numbers, tuples = label_tuples(observation.labels.contiguous().numpy())
    if not 0 < tuples.shape[0] <= observation.labels.shape[0] * codebook.regions:
        return observation, codebook
    regions = Regions.unchecked(torch.from_numpy(numbers)[None], observation.codebook.new_empty(tuples.shape[0], 0))
    return regions, replace(codebook, tuples=torch.from_numpy(tuples))


def float16_holds(books: Iterable[tuple[Tensor, Tensor]]) -> bool:
    """Whether float16 holds every value, and the longest row to FLOAT16_ERROR.

    Args:
        books: codebooks [M, F], and the lengths [M] of their rows.
    """
    longest, channels = 0.0, 0
    for rows, lengths in books:
        if not rows.numel():
            continue
        if max(abs(float(end)) for end in torch.aminmax(rows)) > FLOAT16_MAX:
            return False
        longest, channels = max(longest, float(lengths.max())), rows.shape[1]
    return longest == 0 or FLOAT16_STEP * math.sqrt(channels) <= FLOAT16_ERROR * longest


def row_lengths(rows: Tensor) -> Tensor:
    """[M] f64: lengths of vectors [M, F] f16 or f32, some at a time: in float64 all take four times their place."""
    parts = [
        torch.linalg.vector_norm(part.float(), dim=1, dtype=torch.float64)  # two quick conversions for a slow one
        for part in rows.split(ROWS)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.float64)
