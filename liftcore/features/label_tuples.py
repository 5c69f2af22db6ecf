"""The distinct tuples of labels that the pixels of a region map carry over its levels, numbered as they are met."""

from __future__ import annotations

import numpy as np

from liftcore.features.views import NO_LABEL
from liftcore.jit import inlined, kernel

EMPTY = -1
SPREAD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: neighbouring labels fall far apart


@kernel
def label_tuples(labels, most):
    """Number the tuples; most pixels have their neighbour's, so few are looked up.

    Args:
        labels: [L, h, w] i32, -1 for none. most: tuples that are wanted at most.

    Returns:
        numbers [h, w] i32, -1 where no level has a label; tuples [T, L] i32 in the order of the pixels. Where there
        are more than ``most``, T is ``most + 1`` and the numbers end at the pixel that has the last of them.
    """
    levels, rows, columns = labels.shape
    numbers = np.full((rows, columns), NO_LABEL, np.int32)
    tuples, count = np.empty((most + 1, levels), np.int32), 0
    bits = 4
    while (1 << bits) < 2 * (most + 1):
        bits += 1
    table = np.full(1 << bits, EMPTY, np.int32)
    for y in range(rows):
        for x in range(columns):
            if x > 0 and _same(labels, y, x, y, x - 1):
                numbers[y, x] = numbers[y, x - 1]
                continue
            if y > 0 and _same(labels, y, x, y - 1, x):
                numbers[y, x] = numbers[y - 1, x]
                continue
            if _unlabelled(labels, y, x):
                continue
            place = _place(labels, y, x, bits)
            while table[place] != EMPTY and not _is(labels, y, x, tuples, table[place]):
                place = (place + 1) & (table.shape[0] - 1)
            if table[place] == EMPTY:
                table[place] = count
                tuples[count] = labels[:, y, x]
                count += 1
                if count > most:
                    return numbers, tuples
            numbers[y, x] = table[place]
    return numbers, tuples[:count]


@inlined
def _same(labels, y, x, other_y, other_x):
    same = True
    for level in range(labels.shape[0]):
        same &= labels[level, y, x] == labels[level, other_y, other_x]
    return same


@inlined
def _unlabelled(labels, y, x):
    none = True
    for level in range(labels.shape[0]):
        none &= labels[level, y, x] < 0
    return none


@inlined
def _is(labels, y, x, tuples, number):
    same = True
    for level in range(labels.shape[0]):
        same &= labels[level, y, x] == tuples[number, level]
    return same


@inlined
def _place(labels, y, x, bits):
    """Where a tuple is looked for first, in a table of so many bits."""
    mixed = np.uint64(0)
    for level in range(labels.shape[0]):
        mixed = (mixed ^ np.uint64(labels[level, y, x] + 1)) * SPREAD
        mixed ^= mixed >> np.uint64(32)
    return np.int64(mixed >> np.uint64(64 - bits))
