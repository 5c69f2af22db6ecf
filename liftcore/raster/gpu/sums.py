"""Sums by key in float64, in an order that knows nothing of how the work was cut.

The terms of a key are added unit by unit of tiles (``frame.UNIT``), and then the units' sums. A stable sort brings
terms together in the order in which they came, runs of up to ``PART`` of them are added one after the other, and runs
of such sums, until there is one: no thread waits for a neighbour, none adds to a place that another adds to, and no
splat that half of the image shows keeps the rest waiting. Work is cut between units, so the bits do not know where.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import triton.language as tl

from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.tile_lists import expanded

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

PART = 32  # terms that one thread adds
_RUNS = 128  # runs a program
A_KEY, A_SUM = 64, 24  # bytes of a key and of each of its values while sums are joined


class Sums(NamedTuple):
    """Sums by key, and the keys."""

    keys: Tensor  # [n] i32 or i64, ascending; of a piece once for every unit, those in their order
    values: Tensor  # [n, C] f64


@jit
def _add_runs(
    values, order, firsts, lasts, sums, runs, channels, ORDERED: tl.constexpr, RUNS: tl.constexpr,
    CHANNELS: tl.constexpr,
):  # fmt: skip
    run = tl.program_id(0) * RUNS + tl.arange(0, RUNS)
    channel = tl.arange(0, CHANNELS)
    at = tl.load(firsts + run, mask=run < runs, other=0)
    last = tl.load(lasts + run, mask=run < runs, other=0)
    total = tl.zeros([RUNS, CHANNELS], tl.float64)
    longest = lang.max(last - at, 0)
    for step in range(longest):
        given = at + step < last
        term = at + step
        if ORDERED:
            term = tl.load(order + term, mask=given, other=0)
        place = term[:, None] * channels + channel[None, :]
        value = tl.load(values + place, mask=given[:, None] & (channel < channels)[None, :], other=0.0)
        total += value.to(tl.float64)
    place = run[:, None].to(tl.int64) * channels + channel[None, :]
    tl.store(sums + place, total, mask=(run < runs)[:, None] & (channel < channels)[None, :])


def sums_by_unit(keys: Tensor, units: Tensor, values: Tensor) -> Sums:
    """The sums of a piece.

    Args:
        keys: [n] i32 or i64. units: [n] i32, ascending, whole ones. values: [n, C] f32.
    """
    by_key = torch.sort(keys, stable=True)
    fresh = torch.ones_like(keys, dtype=torch.bool)
    own = units[by_key.indices]
    fresh[1:] = (by_key.values[1:] != by_key.values[:-1]) | (own[1:] != own[:-1])
    firsts = fresh.nonzero()[:, 0]
    counts = torch.diff(firsts, append=firsts.new_tensor([keys.shape[0]]))
    return Sums(by_key.values[firsts], _sums(values.contiguous(), by_key.indices, counts))


class Pieces:
    """The sums of one piece of a view after the other, until all are there.

    Args:
        room: bytes of them that may lie on the device; None for no limit. Beyond it they wait on the host, and are
            joined in ranges of splats that fit.
    """

    def __init__(self, device: torch.device, room: int | None) -> None:
        self._device, self._room = device, room
        self._parts: list[Sums] = []
        self._held = 0

    def add(self, part: Sums) -> None:
        """Keep the sums of the next units."""
        self._held += part.keys.nbytes + part.values.nbytes
        self._parts.append(part)
        if self._room is not None and self._held > self._room:
            self._parts = [Sums(own.keys.cpu(), own.values.cpu()) for own in self._parts]

    def joined(self, splats: int, rows: int = 1) -> Iterator[Sums]:
        """The sums over all units, each key once, in ascending ranges of splats.

        Args:
            rows: keys of a splat: its own are ``splat * rows`` and those that follow.
        """
        waiting = [(0, splats)] if self._room is not None else []
        if self._room is None and self._parts:
            yield _over_units(self._parts)
        while waiting:
            first, last = waiting.pop()
            cuts = [_between(part.keys, first * rows, last * rows) for part in self._parts]
            total = sum(end - begin for begin, end in cuts)
            width = self._parts[0].values.shape[1] if self._parts else 0
            if self._room is not None and last - first > 1 and total * (A_KEY + A_SUM * width) > self._room:
                middle = (first + last) // 2
                waiting += [(middle, last), (first, middle)]
            elif total:
                own = [
                    Sums(part.keys[slice(*cut)].to(self._device), part.values[slice(*cut)].to(self._device))
                    for part, cut in zip(self._parts, cuts, strict=True)
                ]
                yield _over_units(own)


def _between(keys: Tensor, low: int, high: int) -> tuple[int, int]:
    """Where the keys of ``low..high`` stand."""
    if keys.numel() == 0:
        return 0, 0
    places = torch.searchsorted(keys.long(), torch.tensor([low, high], device=keys.device)).tolist()
    return places[0], places[1]


def _over_units(parts: list[Sums]) -> Sums:
    keys, values = (torch.cat(column) for column in zip(*parts, strict=True))
    if len(parts) > 1:
        by_key = torch.sort(keys, stable=True)
        keys, values = by_key.values, values[by_key.indices]
    known, counts = torch.unique_consecutive(keys, return_counts=True)
    return Sums(known, _sums(values, None, counts))


def _sums(values: Tensor, order: Tensor | None, counts: Tensor) -> Tensor:
    """Sums [u, C] f64 of runs of ``counts`` terms, which ``order`` names one after the other; None as they lie."""
    while True:
        runs = (counts + PART - 1) // PART
        key, number = expanded(runs)
        ends = torch.cumsum(counts, 0)
        firsts = (ends - counts)[key] + number * PART
        lasts = torch.minimum(firsts + PART, ends[key])
        sums = torch.empty(key.shape[0], values.shape[1], dtype=torch.float64, device=values.device)
        launch(
            _add_runs, -(-key.shape[0] // _RUNS), values, firsts if order is None else order, firsts, lasts, sums,
            key.shape[0], values.shape[1], ORDERED=order is not None, RUNS=_RUNS,
            CHANNELS=1 << (values.shape[1] - 1).bit_length(),
        )  # fmt: skip
        if key.shape[0] == counts.shape[0]:
            return sums
        values, counts, order = sums, runs, None
