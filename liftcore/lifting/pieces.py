"""W of a lift in pieces, and the arrays that its steps make.

A step (`liftcore.lifting.steps`) works on a piece of views, which has all splats of their regions, or on a block of
splats, which has all their views. It loads the arrays of earlier steps and saves its own, by the name of the step and
the number of the piece; tables of the whole scene have no number. Here all of W is one piece, in the memory of this
process; `lifting.engines.blocks` has pieces in files.

Tables with a row a splat (W, the consensus of its entries, tuples) are stored in parts, by views. Each part has some
rows of a block and some columns of the table, in the order of the columns: a row of the block is the concatenation of
its rows in all parts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.runtime.jit import kernel
from liftcore.runtime.memory import zeros
from liftcore.solve.sums import PieceSums, sum_pieces
from liftcore.values.region_weights import MEMORY_LIMIT, MOST_REGIONS, RegionWeights, row_blocks, run_each

if TYPE_CHECKING:
    from liftcore.solve.codebook import Codebook
    from liftcore.solve.rays import SampledRays
    from liftcore.values.settings import LiftSettings

PIECE_VIEWS = 8  # of a piece of a lift in blocks: some seconds of work, which is what is lost with a worker
ROWS = 1 << 17  # splats of a block: with 512 channels of float16, 128 MiB
SELECTED = 1 << 22  # splats beyond which a worker loads only those that its views see: 1 GB in the raster
Shape = tuple[int, int]  # of a table of sums


@dataclass(frozen=True, kw_only=True)
class Pieces:
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
    memory_limit: int | None = None  # bytes of X, beyond which it is a mapped file; None for no limit
    arrays: dict[tuple[str, int | None], dict[str, Any]] = field(default_factory=dict)

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
    def means(self) -> Tensor:
        """[P, 3], of the splats."""
        return self.load("scene")["means"]

    @property
    def codebook(self) -> Codebook:
        """E of all views."""
        return self.load("scene")["codebook"]

    def has(self, step: str, number: int) -> bool:
        """Return True if a piece of a step is done."""
        return (step, number) in self.arrays

    def load(self, step: str, number: int | None = None) -> dict[str, Any]:
        """Return the arrays of a piece by name, or those of a table."""
        return self.arrays[step, number]

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
        parts = list(sums) if shape is None else [PieceSums.of(sum_pieces(sums, shape))]
        columns = {name: part.numpy() if isinstance(part, Tensor) else part for name, part in arrays.items()}
        self.arrays[step, number] = columns | {"pieces": parts}

    def sums(self, step: str) -> Iterable[PieceSums]:
        """Iterate over the sums of all pieces of a step, in order."""
        return self.arrays[step, 0]["pieces"]

    def drop(self, *steps: str) -> None:
        """Free the memory of steps that are read no more."""
        for step in steps:
            self.arrays.pop((step, 0), None)

    def writable(self, array: np.ndarray) -> Tensor:
        """Return the values of a loaded array, to be overwritten."""
        return torch.from_numpy(array)

    def new_features(self, _piece: int) -> Tensor:
        """Return zeros for X of a block of splats."""
        size = self.splats * self.channels * self.dtype.itemsize
        is_large = self.memory_limit is not None and size > self.memory_limit
        return zeros((self.splats, self.channels), self.dtype, name="features", in_file=is_large)

    def save_features(self, piece: int, X: Tensor) -> None:
        """Store X of a block."""
        self.arrays["features", piece] = {"X": X}

    def features(self) -> Tensor:
        """Return X of all blocks, [P, F]."""
        return self.arrays.pop(("features", 0))["X"]

    def samples(self) -> Sequence[SampledRays]:
        """Return the sampled rays of each view."""
        return self.load("scene")["samples"]

    def table(self, step: str, shape: Shape) -> np.ndarray:
        """Add up the sums of a step over all splats."""
        return sum_pieces(self.sums(step), shape)

    def column(self, step: str, name: str) -> np.ndarray:
        """Return a column of all splats [P] from the blocks of a step."""
        return np.concatenate([self.load(step, number)[name] for number in range(self.splat_pieces)])


# ---- rows of tables in parts


@dataclass(frozen=True)
class SomeRows:
    """Rows of one part."""

    rows: np.ndarray  # [r] i32 or i64 ascending, row numbers in the block
    starts: np.ndarray  # [r + 1] i64, offsets of the rows in the values; the first need not be 0
    values: Sequence[np.ndarray]  # each [n]
    base: int = 0  # that is added to the first of them: the number of the part's first region or tuple


def row_starts(parts: Iterable[SomeRows], count: int) -> np.ndarray:
    """Return the offsets of a block's rows, [count + 1] i64."""
    lengths = np.zeros(count + 1, np.int64)
    for part in parts:
        lengths[part.rows + 1] += np.diff(part.starts)
    return np.cumsum(lengths)


def fill_rows(parts: Iterable[SomeRows], starts: np.ndarray, targets: Sequence[np.ndarray]) -> None:
    """Copy the values of all parts to those of the block, whose rows begin at ``starts`` (`row_starts`)."""
    cursors = starts[:-1].copy()
    for part in parts:
        at = cursors[part.rows]
        for source, target, base in zip(part.values, targets, (part.base, 0), strict=False):
            copy_rows(part.starts, at, source, source.dtype.type(base), target)
        cursors[part.rows] += np.diff(part.starts)


def values_of(count: int, dtype: torch.dtype) -> Tensor:
    """Return zeros [n], in a mapped file if they are many."""
    return zeros((count,), dtype, name="weights", in_file=count * dtype.itemsize > MEMORY_LIMIT >> 1)


def gather_rows(
    parts: Callable[[int, int], Iterable[SomeRows]], count: int, dtypes: Sequence[torch.dtype], threads: int | None
) -> tuple[np.ndarray, list[Tensor]]:
    """Return the offsets [count + 1] i64 of a block's rows, and their values, of the given dtypes.

    Args:
        parts: ``parts(first, last)`` returns an iterator over the parts of some rows, one in memory at a time.
    """
    starts = row_starts(parts(0, count), count)
    targets = [values_of(int(starts[-1]), dtype) for dtype in dtypes]

    def fill(first: int, last: int) -> None:
        fill_rows(parts(first, last), starts[first : last + 1], [target.numpy() for target in targets])

    # Each block reads all parts.
    run_each(fill, row_blocks(np.diff(starts), max(count, 1), max(1 << 20, int(starts[-1]) >> 5)), threads)
    return starts, targets


def part_of(
    splats: np.ndarray, starts: np.ndarray, values: Iterable[np.ndarray], ends: tuple[int, int], base: int = 0
) -> SomeRows:
    """Select the rows of a part that are in a block, and their values."""
    first, last = np.searchsorted(splats, ends)
    span = slice(int(starts[first]), int(starts[last]))
    rows, begins = splats[first:last] - ends[0], starts[first : last + 1] - span.start
    return SomeRows(rows, begins, [part[span] for part in values], base)


def region_offsets(counts: Iterable[int]) -> np.ndarray:
    """Return the first region of each view among those of all, [V + 1] i64, from their numbers.

    Raises:
        Unavailable: an entry cannot name so many.
    """
    offsets = np.cumsum([0, *counts])
    if offsets[-1] > MOST_REGIONS:
        got, hint = f"{offsets[-1]} in {offsets.size - 1} views", "lift fewer views, or smaller maps"
        raise Unavailable("features", expected=f"at most {MOST_REGIONS} regions", got=got, hint=hint)
    return offsets


def stacked(parts: Sequence[RegionWeights], splats: int, threads: int | None = None) -> RegionWeights:
    """W of all views, with a row for each of ``splats``, from the W of each; total weight is added up, in f64."""
    offsets, total_weight = region_offsets(int(part.offsets[-1]) for part in parts), np.zeros(splats)
    for first in range(0, len(parts), PIECE_VIEWS):  # sums of pieces are added, as in blocks
        sums = np.zeros(splats)
        for part in parts[first : first + PIECE_VIEWS]:
            sums[part.total_weight_splats.numpy()] += part.total_weight.numpy()
        total_weight += sums

    def rows(first: int, last: int) -> Iterator[SomeRows]:
        for part, base in zip(parts, offsets[:-1], strict=True):
            values = part.region.numpy(), part.weight.numpy()
            yield part_of(part.splats.numpy(), part.indptr.numpy(), values, (first, last), base)

    starts, (region, weight) = gather_rows(rows, splats, (torch.int32, torch.float32), threads)
    hit_splats = np.flatnonzero(total_weight)
    tensors = (
        np.arange(splats, dtype=np.int32),
        starts,
        hit_splats.astype(np.int32),
        total_weight[hit_splats],
        offsets,
    )
    numbers, begins, hits, sums, bases = map(torch.from_numpy, tensors)
    names = tuple(name for part in parts for name in part.views)
    return RegionWeights(numbers, begins, region, weight, hits, sums, bases, names)


def take_rows(starts: np.ndarray, rows: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return some rows [r] of a table: their offsets [r + 1] i64, and their values."""
    begins = np.concatenate([[0], np.cumsum(np.diff(starts)[rows])])
    target = np.empty(begins[-1], values.dtype)
    take(starts, rows, begins, values, target)
    return begins, target


@kernel
def copy_rows(starts, at, source, base, target):
    """Copy row i of the source, from ``starts[i]`` on, to ``at[i]`` of the target, plus ``base``."""
    for i in range(at.size):
        shift = at[i] - starts[i]
        for k in range(starts[i], starts[i + 1]):
            target[k + shift] = source[k] + base


@kernel
def take(starts, rows, begins, values, target):
    """Copy the rows of `take_rows`."""
    for i in range(rows.size):
        shift = begins[i] - starts[rows[i]]
        for k in range(starts[rows[i]], starts[rows[i] + 1]):
            target[k + shift] = values[k]
