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
from math import prod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from liftcore.io.safetensors_file import map_tensors, write_tensors
from liftcore.runtime.jit import kernel
from liftcore.solve.codebook import LEAST_CHANNELS, TABLE_BYTES, Codebook
from liftcore.solve.shared_rows import flat_table, new_table
from liftcore.solve.sums import PieceSums, piece_sums
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import DIRECTIONS

ROWS = 1 << 14  # of a table in float64 at a time
SAMPLE = 1 << 14  # regions from which principal directions are computed
FILE = "directions.safetensors"
NO_DIRECTION = 1e-6  # distance to the mean below which a unit vector has no direction


class RegionDirections:
    """e of the regions of W, [M, D] f32, in slices of columns; computed in one thread, bitwise reproducible.

    Args:
        codebook: E, whose regions are rows.
        totals: [M] f64, the weight of each region before any reweighting. entries: number of entries of W.
        principal: D, if there are more channels and W has many entries per region.
    """

    mean: Tensor  # [F] f64, mu
    totals: Tensor  # [M] f64, the weight of each region

    def __init__(self, codebook: Codebook, totals: Tensor, entries: int, principal: int = DIRECTIONS) -> None:
        self._codebook, self.totals = codebook, totals
        self.mean, self._distances = self._mean_and_distances()
        self._axes = self._principal_axes(entries, principal)

    @property
    def width(self) -> int:
        """The number of columns, D."""
        return self.mean.shape[0] if self._axes is None else self._axes.shape[1]

    def slices(self) -> Iterator[slice]:
        """Return the slices of columns for `table`, such that it takes TABLE_BYTES."""
        step = max(LEAST_CHANNELS, TABLE_BYTES // (4 * max(self.totals.shape[0], 1)))
        return (slice(begin, min(begin + step, self.width)) for begin in range(0, self.width, step))

    def table(self, columns: slice) -> Tensor:
        """Return some columns of e of all regions, [M, C] f32; zeros for regions without direction."""
        if self._axes is None:
            return self._centre(self._codebook.unit_values(columns), columns)
        table = new_table(self._codebook.regions, columns.stop - columns.start).zero_()
        for channels in self._codebook.slices():
            table += self._centre(self._codebook.unit_values(channels), channels) @ self._axes[channels, columns]
        return table

    def save(self, folder: Path) -> None:
        """Write the directions for `StoredDirections`, a file per table."""
        for number, columns in enumerate(self.slices()):
            write_tensors(folder / _table_file(number), {"e": torch.from_numpy(flat_table(self.table(columns)))}, {})
        axes = {} if self._axes is None else {"axes": self._axes}
        write_tensors(folder / FILE, {"mean": self.mean, "totals": self.totals, **axes}, {})

    def of(self, vectors: Tensor) -> Tensor:
        """Return the directions [K, D] f32 of other vectors [K, F], normalised in these columns; zeros for none."""
        wide = vectors.double()
        lengths = torch.linalg.vector_norm(wide, dim=1, keepdim=True)
        nonzero = lengths > 0
        offsets = torch.where(nonzero, wide / torch.where(nonzero, lengths, 1.0) - self.mean, 0.0)
        offsets[torch.linalg.vector_norm(offsets, dim=1) <= NO_DIRECTION] = 0.0
        projected = offsets if self._axes is None else offsets @ self._axes.double()
        return torch.nn.functional.normalize(projected, dim=1, eps=NO_DIRECTION).float()

    def _mean_and_distances(self) -> tuple[Tensor, Tensor]:
        """Return mu, and the distance [M] f64 of each region's unit vector from it, zero without a direction."""
        codebook, totals = self._codebook, self.totals
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
        return mean, torch.where((distances > NO_DIRECTION) & nonzero, distances, 0.0)

    def _principal_axes(self, entries: int, number: int) -> Tensor | None:
        """Return the principal axes [F, number] f32 of e, each region by its weight; None: all channels.

        With few entries per region, as in dense maps, projecting all regions takes longer than comparing all
        channels.
        """
        codebook = self._codebook
        if codebook.channels <= number or entries <= number * codebook.regions:
            return None
        step = -(-codebook.regions // SAMPLE)
        e = self._full_rows(slice(None, None, step)).double()
        return torch.linalg.eigh((e * self.totals[::step, None]).T @ e)[1][:, -number:].float().contiguous()

    def _full_rows(self, regions: slice) -> Tensor:
        """Return all channels of e of some regions, [m, F] f32."""
        channels = list(self._codebook.slices())
        parts = (self._centre(self._codebook.unit_values(part)[regions], part, regions) for part in channels)
        return torch.cat(list(parts), dim=1)

    def _centre(self, unit: Tensor, channels: slice, regions: slice = slice(None)) -> Tensor:
        """Replace unit vectors of regions [m, C] f32 by e, in place."""
        distances = self._distances[regions]
        inverse = torch.where(distances > 0, 1.0 / distances, 0.0)
        for part, scales in zip(unit.split(ROWS), inverse.split(ROWS), strict=True):
            part.copy_((part.double() - self.mean[channels]) * scales[:, None])
        return unit


class StoredDirections(RegionDirections):
    """Directions of `RegionDirections.save`, mapped from a folder, so that jobs compute no table."""

    def __init__(self, folder: Path) -> None:
        arrays = {name: torch.from_numpy(array) for name, array in map_tensors(folder / FILE)[0].items()}
        self.mean, self.totals, self._axes = arrays["mean"], arrays["totals"], arrays.get("axes")
        self._folder = folder

    def table(self, columns: slice) -> Tensor:
        """Return some columns as `RegionDirections.table`; they must be one of the slices."""
        number = [part.start for part in self.slices()].index(columns.start)
        flat = torch.from_numpy(map_tensors(self._folder / _table_file(number))[0]["e"])  # of `flat_table`
        shape = self.totals.shape[0], columns.stop - columns.start
        return flat[: prod(shape)].view(shape)


def _table_file(number: int) -> str:
    return f"directions-{number:05}.safetensors"


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
