"""What the solution on a device takes of its memory, and how the work is cut to fit.

Blocks of splats follow the memory that is free, in whole grains; slices of channels follow the codebooks alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.raster.base import RegionWeights
    from liftcore.solve.view_weights import WeightStore

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
    store: Sequence[RegionWeights] | WeightStore, count: int, width: int, room: int
) -> list[tuple[int, int]]:
    """(first, last) of the blocks: whole grains, as many as ``room`` bytes hold, at least one."""
    edges = np.append(np.arange(0, count, GRAIN), count)
    entries = _entries_between(store, edges)
    blocks, first, held = [], 0, 0
    for grain, own in enumerate(entries.tolist()):
        grown = block_bytes(int(edges[grain + 1] - edges[first]), held + own, width)
        if grain > first and (grown > room or held + own > np.iinfo(np.int32).max):
            blocks.append((int(edges[first]), int(edges[grain])))
            first, held = grain, 0
        held += own
    return [*blocks, (int(edges[first]), count)]


def _entries_between(store: Sequence[RegionWeights] | WeightStore, edges: np.ndarray) -> np.ndarray:
    """[n] i64, the entries of W of the splats between edges [n + 1], summed where they lie."""
    sums: dict[torch.device, tuple[torch.Tensor, torch.Tensor]] = {}
    for view in store:
        place = view.splats.device
        if place not in sums:
            own = torch.from_numpy(edges).to(place, torch.int32)
            sums[place] = own, torch.zeros(edges.size - 1, dtype=torch.int64, device=place)
        own, total = sums[place]
        total += view.indptr[torch.searchsorted(view.splats, own)].diff()
    return sum((total.cpu().numpy() for _, total in sums.values()), np.zeros(edges.size - 1, np.int64))


def bounds_of(store: Sequence[RegionWeights] | WeightStore, splats: tuple[int, int]) -> list[list[int]]:
    """[V, 4]: first and last + 1 row of some splats in every view, and first and last + 1 entry; one wait a card."""
    edges: dict[torch.device, torch.Tensor] = {}
    found: dict[torch.device, list[torch.Tensor]] = {}
    for view in store:
        place = view.splats.device
        if place not in edges:
            edges[place] = torch.tensor(splats, dtype=torch.int32, device=place)
        rows = torch.searchsorted(view.splats, edges[place])
        found.setdefault(place, []).append(torch.cat([rows, view.indptr[rows]]))
    told = {place: iter(torch.stack(parts).tolist()) for place, parts in found.items()}
    return [next(told[view.splats.device]) for view in store]
