"""Sums over all splats, in an order that depends neither on the division into blocks nor on the number of threads.

A step needs few numbers of the whole scene: the weight of each region, its reliability, the mean of all cosines.
Splats are divided into pieces of PIECE, from the first splat of the scene on. A piece is summed entry by entry, and
the sums of pieces are added in order. A job on a block of splats that begins and ends at a piece returns the sums of
its pieces, and all of them together are bitwise identical to those of an undivided scene.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.cores import cores

PIECE = 1 << 15  # splats
QUEUED_PER_THREAD = 2  # finished results per thread that may wait for earlier ones


@dataclass(frozen=True)
class PieceSums:
    """The nonzero columns of one piece's table of sums."""

    places: np.ndarray  # [n] i64, ascending
    values: np.ndarray  # [k, n] f64

    @classmethod
    def of(cls, table: np.ndarray) -> "PieceSums":
        """Return the nonzero columns of a table [k, size] f64."""
        places = np.flatnonzero(table.any(axis=0))
        return cls(places, table[:, places])


def pieces(splats: int) -> list[tuple[int, int]]:
    """Return (first, last + 1) splat of every piece."""
    return [(first, min(first + PIECE, splats)) for first in range(0, splats, PIECE)]


def piece_sums(
    work: Callable[[int, int, np.ndarray], None], splats: int, shape: tuple[int, int], threads: int | None
) -> Iterator[PieceSums]:
    """Yield the sums of every piece, in order; few of them are in memory at a time.

    Args:
        work: ``work(first, last, table)`` adds those of some splats to a table of that shape, f64.
    """

    def sum_piece(first: int, last: int) -> PieceSums:
        table = np.zeros(shape)
        work(first, last, table)
        return PieceSums.of(table)

    return in_order(sum_piece, pieces(splats), threads)


def sum_pieces(parts: Iterable[PieceSums], shape: tuple[int, int]) -> np.ndarray:
    """Add the sums of all pieces in order; return a table [k, size] f64."""
    table = np.zeros(shape)
    for part in parts:
        table[:, part.places] += part.values
    return table


def in_order(work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], threads: int | None) -> Iterator[Any]:
    """Yield the results of ``work`` for each tuple of arguments, in order, from a thread pool; few are queued."""
    count = threads or cores()
    waiting, remaining = deque[Future[Any]](), iter(arguments)
    with ThreadPoolExecutor(count) as pool:
        for item in remaining:
            waiting.append(pool.submit(work, *item))
            if len(waiting) > QUEUED_PER_THREAD * count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def pack_sums(parts: Sequence[PieceSums]) -> dict[str, Tensor]:
    """Return the sums of some pieces as tensors of a file, one piece after the other."""
    ends = np.cumsum([0, *(part.places.size for part in parts)])
    return {
        "sums/ends": torch.from_numpy(ends),
        "sums/places": torch.from_numpy(np.concatenate([part.places for part in parts])),
        "sums/values": torch.from_numpy(np.concatenate([part.values for part in parts], axis=1)),
    }


def unpack_sums(tensors: dict[str, np.ndarray]) -> Iterator[PieceSums]:
    """Yield the pieces of a file's tensors, in order."""
    ends, places, values = (tensors[f"sums/{name}"] for name in ("ends", "places", "values"))
    for first, last in pairwise(ends.tolist()):
        yield PieceSums(places[first:last], values[:, first:last])
