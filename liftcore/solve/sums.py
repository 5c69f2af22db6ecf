"""Sums over all splats, in an order that neither the cut into blocks nor the number of threads changes.

A step needs few numbers of the whole scene: the weight of each region, its reliability, the mean of all cosines.
Splats are cut into pieces of PIECE, from the first splat of the scene on. The sum of a piece is taken entry by entry,
and the sums of pieces are added up in their order. Whoever works on a block of splats that begins and ends at a piece
can hand on the sums of its pieces, and all of them together give the bits of a scene that lies in one place.
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
AHEAD = 2  # results a thread, that wait for those before them


@dataclass(frozen=True)
class PieceSums:
    """Several sums of one piece of splats for each place of a table, of the places where any is not zero."""

    places: np.ndarray  # [n] i64, ascending
    values: np.ndarray  # [k, n] f64

    @classmethod
    def of(cls, table: np.ndarray) -> "PieceSums":
        """Those of a table [k, size] f64."""
        places = np.flatnonzero(table.any(axis=0))
        return cls(places, table[:, places])


def pieces(splats: int) -> list[tuple[int, int]]:
    """(first, last + 1) splat of every piece."""
    return [(first, min(first + PIECE, splats)) for first in range(0, splats, PIECE)]


def piece_sums(
    work: Callable[[int, int, np.ndarray], None], splats: int, shape: tuple[int, int], threads: int | None
) -> Iterator[PieceSums]:
    """The sums of every piece, in their order; few of them are in memory at a time.

    Args:
        work: ``work(first, last, table)`` adds those of some splats to a table of that shape, f64.
        threads: None takes the cores that this process may use. The result is bitwise identical for any value.
    """

    def summed(first: int, last: int) -> PieceSums:
        table = np.zeros(shape)
        work(first, last, table)
        return PieceSums.of(table)

    return in_order(summed, pieces(splats), threads)


def added(parts: Iterable[PieceSums], shape: tuple[int, int]) -> np.ndarray:
    """The sums of all pieces, added up in their order: a table [k, size] f64."""
    table = np.zeros(shape)
    for part in parts:
        table[:, part.places] += part.values
    return table


def in_order(work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], threads: int | None) -> Iterator[Any]:
    """The results of work for each tuple of arguments, in their order, by so many threads; few wait at a time."""
    count = threads or cores()
    waiting, left = deque[Future[Any]](), iter(arguments)
    with ThreadPoolExecutor(count) as pool:
        for own in left:
            waiting.append(pool.submit(work, *own))
            if len(waiting) > AHEAD * count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def packed(parts: Sequence[PieceSums]) -> dict[str, Tensor]:
    """The sums of some pieces as tensors of a file, one piece after the other."""
    ends = np.cumsum([0, *(part.places.size for part in parts)])
    return {
        "sums/ends": torch.from_numpy(ends),
        "sums/places": torch.from_numpy(np.concatenate([part.places for part in parts])),
        "sums/values": torch.from_numpy(np.concatenate([part.values for part in parts], axis=1)),
    }


def unpacked(tensors: dict[str, np.ndarray]) -> Iterator[PieceSums]:
    """The pieces of a file's tensors, in their order."""
    ends, places, values = (tensors[f"sums/{name}"] for name in ("ends", "places", "values"))
    for first, last in pairwise(ends.tolist()):
        yield PieceSums(places[first:last], values[:, first:last])
