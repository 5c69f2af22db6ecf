"""What the solution on a device takes of its memory, and how the work is cut to fit.

Blocks of splats follow the memory that is free, in whole grains; slices of channels follow the codebooks alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.raster.protocol import RegionWeights
    from liftcore.solve.view_weights import ViewWeights

GRAIN = 256  # splats; blocks end at their multiples
SLICE = 512  # channels at most
LEAST_SLICE = 8  # channels at least, however long the codebooks are: each slice gathers W anew
SLICE_BYTES = 1 << 29  # of a slice of all codebooks
ENTRY_BYTES = 80  # of an entry of W while it is gathered: twice itself, where it comes from, its share in float64
SPLAT_BYTES = 64
SUM_BYTES = 48  # of a channel of a splat: its parts in both precisions, the sum, its squares, what goes to the host
SPARE = 0.8  # of the free memory: what is freed does not lie in one piece
UNLIMITED = 1 << 30  # of a block, on a device without a memory of its own


def device_slices(rows: int, channels: int) -> list[tuple[int, int]]:
    """(begin, end) of the channels that are solved together, for codebooks of so many rows in all."""
    step = min(SLICE, max(LEAST_SLICE, SLICE_BYTES // (4 * max(rows, 1))))
    return [(begin, min(begin + step, channels)) for begin in range(0, channels, step)]


def book_bytes(rows: int, width: int, unit: bool) -> int:
    """Bytes of a slice of all codebooks; twice where unit vectors stand beside them."""
    return 4 * rows * width * (1 if unit else 2)


def block_bytes(splats: int, entries: int, width: int) -> int:
    """Bytes that a block takes at its peak, beside the codebooks."""
    return splats * (SPLAT_BYTES + SUM_BYTES * width) + entries * (ENTRY_BYTES + SUM_BYTES * width // GRAIN)


def block_room(free: int | None, rows: int, width: int, unit: bool) -> int:
    """Bytes that a block may take, where ``free`` are free beside nothing of this solution."""
    return UNLIMITED if free is None else int(SPARE * free) - book_bytes(rows, width, unit)


def splat_blocks(
    store: Sequence[RegionWeights] | ViewWeights, count: int, width: int, room: int
) -> list[tuple[int, int]]:
    """(first, last) of the blocks: whole grains, as many as ``room`` bytes hold, at least one."""
    edges = np.append(np.arange(0, count, GRAIN), count)
    entries = np.zeros(edges.size - 1, np.int64)
    for view in store:
        places = np.searchsorted(view.splats.numpy(), edges)
        entries += np.diff(view.row_starts.numpy()[places])
    blocks, first, held = [], 0, 0
    for grain, own in enumerate(entries.tolist()):
        grown = block_bytes(int(edges[grain + 1] - edges[first]), held + own, width)
        if grain > first and (grown > room or held + own > np.iinfo(np.int32).max):
            blocks.append((int(edges[first]), int(edges[grain])))
            first, held = grain, 0
        held += own
    return [*blocks, (int(edges[first]), count)]
