"""Sums by key in float64, in one fixed order.

A stable sort brings the terms of a key together in the order in which they came. Runs of up to ``PART`` terms are
added one after the other, then runs of such sums, until each key has one: no thread waits for a neighbour, none adds
to a place that another adds to, and no splat that half of the image shows keeps the rest waiting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl

from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.tile_lists import expanded

if TYPE_CHECKING:
    from torch import Tensor

PART = 32  # terms that one thread adds
_RUNS = 128  # runs a program


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


def sums_by_key(keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct keys, ascending [u], and the sums of their values [u, C] f64, for values [n, C] f32 or f64."""
    by_key = torch.sort(keys, stable=True)
    known, counts = torch.unique_consecutive(by_key.values, return_counts=True)
    return known, _sums(values.contiguous(), by_key.indices, counts)


def _sums(values: Tensor, order: Tensor, counts: Tensor) -> Tensor:
    """Sums [u, C] f64 of runs of ``counts`` terms, which ``order`` names one after the other."""
    ordered = True
    while True:
        runs = (counts + PART - 1) // PART
        key, number = expanded(runs)
        ends = torch.cumsum(counts, 0)
        firsts = (ends - counts)[key] + number * PART
        lasts = torch.minimum(firsts + PART, ends[key])
        sums = torch.empty(key.shape[0], values.shape[1], dtype=torch.float64, device=values.device)
        launch(
            _add_runs, -(-key.shape[0] // _RUNS), values, order, firsts, lasts, sums, key.shape[0], values.shape[1],
            ORDERED=ordered, RUNS=_RUNS, CHANNELS=1 << (values.shape[1] - 1).bit_length(),
        )  # fmt: skip
        if key.shape[0] == counts.shape[0]:
            return sums
        values, counts, ordered = sums, runs, False
