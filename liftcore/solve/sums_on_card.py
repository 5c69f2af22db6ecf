"""Sums over entries of a W in a GPU's memory, each in a fixed order, for all regions or all pairs of numbers.

Entries are sorted by number, and segments summed: atomic additions of floats would have no order. Integers may be
added in any.
"""

from math import frexp

import torch
from torch import Tensor

from liftcore.solve.membership_on_card import BLOCK_ENTRIES, BLOCK_ROWS
from liftcore.values.region_weights import RegionWeights, from_zero, segment_sums

SUM_BITS = 62  # of the largest sum of integer weights


def integer_weights(weights: Tensor, count: int) -> Tensor:
    """Round weights [n] f64, none negative, to multiples [n] i64 of a unit: ``count`` of the largest do not overflow.

    The unit is a power of two, so that sums of such multiples compare as those of the weights.
    """
    largest = frexp(float(weights.max()) if len(weights) else 0.0)[1] + count.bit_length()
    return (weights * 2.0 ** (SUM_BITS - largest)).round().long()


def region_totals_on_card(W: RegionWeights) -> Tensor:
    """Return the weight of each region, [M] f64 on the CPU, as `liftcore.solve.directions.region_totals` does."""
    totals = torch.zeros(int(W.offsets[-1]), dtype=torch.float64, device=W.device)
    for first, last in W.blocks(BLOCK_ROWS, BLOCK_ENTRIES):
        entries = slice(*W.indptr[[first, last]].tolist())
        totals += sums_by_number(W.region[entries], W.weight[entries].double()[None], len(totals))[0]
    return totals.cpu()


def sums_by_number(number: Tensor, values: Tensor, count: int) -> Tensor:
    """Return sums [k, count] f64 of values [k, n] f64 of entries by their numbers [n] int, in a fixed order."""
    starts = from_zero(torch.bincount(number, minlength=count))
    order = torch.argsort(number, stable=True)
    return torch.stack([segment_sums(part[order], starts) for part in values])


def run_starts(numbers: Tensor) -> Tensor:
    """Return where runs of equal numbers [n] begin, and n: [runs + 1] i64."""
    begins = torch.ones_like(numbers, dtype=torch.bool)
    torch.not_equal(numbers[1:], numbers[:-1], out=begins[1:])
    return torch.cat([torch.nonzero(begins)[:, 0], begins.new_full((1,), len(numbers), dtype=torch.int64)])
