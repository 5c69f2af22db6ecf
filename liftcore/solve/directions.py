"""Directions of regions: their vectors relative to the scene's mean.

With u_m the unit vector of region m and ``mu = sum W u / sum W`` the scene's mean over all splats and views, its
direction is ``e_m = (u_m - mu) / |u_m - mu|``: the vectors of an encoder lie in a narrow cone, so raw cosines are all
similar. A zero vector and the mean itself have no direction, and are zero.

With many channels and many entries per region, directions are expressed in a few principal ones. These suppress noise
that regions do not share.

Of W only the weight of each region is needed, a sum over all splats (`region_totals`); all else is a function of the
codebook, of the size of M.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.solve.codebook import LEAST_CHANNELS, TABLE_BYTES, Codebook
from liftcore.solve.shared_rows import new_table
from liftcore.solve.sums import PieceSums, piece_sums
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import DIRECTIONS

ROWS = 1 << 14  # of a table in float64 at a time
SAMPLE = 1 << 14  # regions from which principal directions are computed
NO_DIRECTION = 1e-6  # distance to the mean below which a unit vector has no direction


@dataclass(frozen=True)
class RegionDirections:
    """e of the regions of W, [M, D] f32, in slices of columns; computed in one thread, bitwise reproducible."""

    codebook: Codebook  # E, whose regions are rows
    mean: Tensor  # [F] f64, mu
    distances: Tensor  # [M] f64, of each region's unit vector from it; zero without a direction
    axes: Tensor | None = None  # [F, D] f32, principal directions; None: all channels

    @classmethod
    def of(cls, codebook: Codebook, totals: Tensor, entries: int, principal: int = DIRECTIONS) -> "RegionDirections":
        """Compute the directions.

        Args:
            totals: [M] f64, the weight of each region before any reweighting. entries: number of entries of W.
            principal: D, if there are more channels and W has many entries per region.
        """
        nonzero = torch.cat(codebook.lengths) > 0
        total = float(totals[nonzero].sum()) or 1.0
        mean, squares = torch.zeros(codebook.channels, dtype=torch.float64), torch.zeros_like(totals)
        for channels in codebook.slices():
            unit = codebook.unit_values(channels)
            for part, weights in zip(unit.split(ROWS), totals.split(ROWS), strict=True):
                mean[channels] += weights @ part.double() / total
            for part, squared in zip(unit.split(ROWS), squares.split(ROWS), strict=True):
                squared.add_((part.double() - mean[channels]).square().sum(dim=1))
        distances = squares.sqrt()
        distances = torch.where((distances > NO_DIRECTION) & nonzero, distances, 0.0)
        directions = cls(codebook, mean, distances)
        # With few entries per region, as in dense maps, a projection takes longer than comparing all channels.
        if codebook.channels <= principal or entries <= principal * codebook.regions:
            return directions
        step = -(-codebook.regions // SAMPLE)
        e = directions._full_rows(slice(None, None, step)).double()
        axes = torch.linalg.eigh((e * totals[::step, None]).T @ e)[1][:, -principal:].float().contiguous()
        return cls(codebook, mean, distances, axes)

    @property
    def width(self) -> int:
        """The number of columns, D."""
        return (self.mean if self.axes is None else self.axes).shape[-1]

    def slices(self) -> Iterator[slice]:
        """Return the slices of columns for `table`, such that it takes TABLE_BYTES."""
        step = max(LEAST_CHANNELS, TABLE_BYTES // (4 * max(self.codebook.regions, 1)))
        return (slice(begin, min(begin + step, self.width)) for begin in range(0, self.width, step))

    def table(self, columns: slice) -> Tensor:
        """Return some columns of e of all regions, [M, C] f32; zeros for regions without direction."""
        if self.axes is None:
            return self._centre(self.codebook.unit_values(columns), columns)
        table = new_table(self.codebook.regions, columns.stop - columns.start).zero_()
        for channels in self.codebook.slices():
            table += self._centre(self.codebook.unit_values(channels), channels) @ self.axes[channels, columns]
        return table

    def _full_rows(self, regions: slice) -> Tensor:
        """Return all channels of e of some regions, [m, F] f32."""
        channels = list(self.codebook.slices())
        parts = (self._centre(self.codebook.unit_values(part)[regions], part, regions) for part in channels)
        return torch.cat(list(parts), dim=1)

    def _centre(self, unit: Tensor, channels: slice, regions: slice = slice(None)) -> Tensor:
        """Replace unit vectors of regions [m, C] f32 by e, in place."""
        distances = self.distances[regions]
        inverse = torch.where(distances > 0, 1.0 / distances, 0.0)
        for part, scales in zip(unit.split(ROWS), inverse.split(ROWS), strict=True):
            part.copy_((part.double() - self.mean[channels]) * scales[:, None])
        return unit


def region_totals(W: RegionWeights, threads: int | None = None) -> Iterator[PieceSums]:
    """Yield the weight of each region per piece of splats, [1, M]."""
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))

    def add(first: int, last: int, table: np.ndarray) -> None:
        add_weights(first, last, indptr, region, weight, table[0])

    return piece_sums(add, indptr.size - 1, (1, int(W.offsets[-1])), threads)


@kernel
def add_weights(first, last, indptr, region, weight, totals):
    """Add the weights of rows ``first..last`` to those of their regions [M] f64."""
    for k in range(indptr[first], indptr[last]):
        totals[region[k]] += weight[k]
