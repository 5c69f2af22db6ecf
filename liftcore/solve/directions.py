"""Directions of regions: what their vectors say beyond what all of a scene's say.

With u_m the unit vector of region m and ``mu = sum W u / sum W`` the scene's mean over all splats and views, its
direction is ``e_m = (u_m - mu) / |u_m - mu|``: the vectors of an encoder lie in a narrow cone, so raw cosines are all
alike. A zero vector and the mean itself have none, and are zero.

Where the channels are many and a region has many entries, directions are written in a few principal ones. Of
noise these keep what regions share with one another, so cosines between noisy vectors grow alike.

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
from liftcore.solve.clusters import EXACT_CHANNELS, principal_axes
from liftcore.solve.codebook import LEAST_CHANNELS, TABLE_BYTES, Codebook
from liftcore.solve.shared_rows import flat_table, new_table
from liftcore.solve.sums import PieceSums, added, piece_sums
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import DIRECTIONS

CPU = torch.device("cpu")
ROWS = 1 << 14  # of a table in float64 at a time
SAMPLE = 1 << 14  # regions that say which directions are principal
FILE = "directions.safetensors"
NO_DIRECTION = 1e-6  # a unit vector nearer to the mean than that is the mean


class RegionDirections:
    """e of the regions of W, [M, D] f32 in slices of its columns; work of one thread, whose bits are fixed.

    Args:
        codebook: E, whose regions are rows.
        totals: [M] f64, the weight of each region before any reweighting. entries: how many W has.
        principal: D, in which cosines are taken where channels are more and regions few beside entries.
    """

    mean: Tensor  # [F] f64, mu
    totals: Tensor  # [M] f64, the weight of each region

    def __init__(self, codebook: Codebook, totals: Tensor, entries: int, principal: int = DIRECTIONS) -> None:
        self._codebook, self.totals = codebook, totals
        self.mean, self._distances = self._measured()
        self._axes = self._principal(entries, principal)

    @classmethod
    def of_weights(
        cls, W: RegionWeights, codebook: Codebook, principal: int = DIRECTIONS, threads: int | None = None
    ) -> "RegionDirections":
        """Those of a scene whose W, of all views by rows of codebooks, lies in one place, on the CPU."""
        totals = added(region_totals(W, threads), (1, codebook.regions))[0]
        return cls(codebook, torch.from_numpy(totals), W.region.shape[0], principal)

    @property
    def width(self) -> int:
        """D, how many numbers a direction has."""
        return self.mean.shape[0] if self._axes is None else self._axes.shape[1]

    def slices(self) -> Iterator[slice]:
        """The columns that `table` gives at a time, so that it takes TABLE_BYTES."""
        step = max(LEAST_CHANNELS, TABLE_BYTES // (4 * max(self.totals.shape[0], 1)))
        return (slice(begin, min(begin + step, self.width)) for begin in range(0, self.width, step))

    def table(self, columns: slice) -> Tensor:
        """Some columns of e of all regions, [M, C] f32; zeros for none."""
        if self._axes is None:
            return self._centred(self._codebook.unit_values(columns, CPU), columns)
        table = new_table(self._codebook.regions, columns.stop - columns.start, CPU).zero_()
        for own in self._codebook.slices():
            table += self._centred(self._codebook.unit_values(own, CPU), own) @ self._axes[own, columns]
        return table

    def save(self, folder: Path) -> None:
        """Write them for `StoredDirections`: a file a table, of which each is made once."""
        for number, columns in enumerate(self.slices()):
            write_tensors(folder / _table_file(number), {"e": torch.from_numpy(flat_table(self.table(columns)))}, {})
        axes = {} if self._axes is None else {"axes": self._axes}
        write_tensors(folder / FILE, {"mean": self.mean, "totals": self.totals, **axes}, {})

    def of(self, vectors: Tensor) -> Tensor:
        """Directions [K, D] f32 of other vectors [K, F], of length one in these columns; zeros for none."""
        wide = vectors.double()
        lengths = torch.linalg.vector_norm(wide, dim=1, keepdim=True)
        known = lengths > 0
        offsets = torch.where(known, wide / torch.where(known, lengths, 1.0) - self.mean, 0.0)
        offsets[torch.linalg.vector_norm(offsets, dim=1) <= NO_DIRECTION] = 0.0
        shown = offsets if self._axes is None else offsets @ self._axes.double()
        return torch.nn.functional.normalize(shown, dim=1, eps=NO_DIRECTION).float()

    def _measured(self) -> tuple[Tensor, Tensor]:
        """mu, and the distance of each region's unit vector from it [M] f64, zero where it has no direction."""
        codebook, totals = self._codebook, self.totals
        known = torch.cat(codebook.lengths) > 0
        whole = float(totals[known].sum()) or 1.0
        mean, squares = torch.zeros(codebook.channels, dtype=torch.float64), torch.zeros_like(totals)
        for channels in codebook.slices():
            unit = codebook.unit_values(channels, CPU)
            for part, own in zip(unit.split(ROWS), totals.split(ROWS), strict=True):
                mean[channels] += own @ part.double() / whole
            for part, squared in zip(unit.split(ROWS), squares.split(ROWS), strict=True):
                squared.add_((part.double() - mean[channels]).square().sum(dim=1))
        distances = squares.sqrt()
        return mean, torch.where((distances > NO_DIRECTION) & known, distances, 0.0)

    def _principal(self, entries: int, number: int) -> Tensor | None:
        """The axes [F, number] f32 in which e spreads most, each region by its weight; None: all channels.

        Where a dense map has a region a few entries, turning them all takes longer than comparing them whole.
        """
        codebook = self._codebook
        if codebook.channels <= number or entries <= number * codebook.regions:
            return None
        step = -(-codebook.regions // SAMPLE)
        e = self._whole_rows(slice(None, None, step))
        if codebook.channels > EXACT_CHANNELS:
            weighted = e * self.totals[::step, None].sqrt().float()
            return torch.from_numpy(principal_axes(weighted.numpy(), number))
        e = e.double()
        return torch.linalg.eigh((e * self.totals[::step, None]).T @ e)[1][:, -number:].float().contiguous()

    def _whole_rows(self, chosen: slice) -> Tensor:
        """All channels of e of some regions, [m, F] f32."""
        channels = list(self._codebook.slices())
        parts = (self._centred(self._codebook.unit_values(own, CPU)[chosen], own, chosen) for own in channels)
        return torch.cat(list(parts), dim=1)

    def _centred(self, unit: Tensor, channels: slice, chosen: slice = slice(None)) -> Tensor:
        """Unit vectors of regions [m, C] f32 become e, in place."""
        distances = self._distances[chosen]
        inverse = torch.where(distances > 0, 1.0 / distances, 0.0)
        for part, own in zip(unit.split(ROWS), inverse.split(ROWS), strict=True):
            part.copy_((part.double() - self.mean[channels]) * own[:, None])
        return unit


class StoredDirections(RegionDirections):
    """Those that `RegionDirections.save` wrote into a folder, mapped: whoever compares regions makes no table."""

    def __init__(self, folder: Path) -> None:
        arrays = {name: torch.from_numpy(array) for name, array in map_tensors(folder / FILE)[0].items()}
        self.mean, self.totals, self._axes = arrays["mean"], arrays["totals"], arrays.get("axes")
        self._folder = folder

    def table(self, columns: slice) -> Tensor:
        """See `RegionDirections`; the columns are one of the slices."""
        number = [own.start for own in self.slices()].index(columns.start)
        flat = torch.from_numpy(map_tensors(self._folder / _table_file(number))[0]["e"])  # as `flat_table` has it
        shape = self.totals.shape[0], columns.stop - columns.start
        return flat[: prod(shape)].view(shape)


def _table_file(number: int) -> str:
    return f"directions-{number:05}.safetensors"


def region_totals(W: RegionWeights, threads: int | None = None) -> Iterator[PieceSums]:
    """The weight of each region at every piece of splats, [1, M]."""
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))

    def add(first: int, last: int, table: np.ndarray) -> None:
        add_weights(first, last, indptr, region, weight, table[0])

    return piece_sums(add, indptr.size - 1, (1, int(W.offsets[-1])), threads)


@kernel
def add_weights(first, last, indptr, region, weight, totals):
    """Add the weights of rows ``first..last`` to those of their regions [M] f64."""
    for k in range(indptr[first], indptr[last]):
        totals[region[k]] += weight[k]
