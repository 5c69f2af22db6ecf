"""``argmax(A onehot(labels))``: the label of the most weight on each ray (paper, Post Aggregation Filtering).

A splat adds to one column of the one-hot render only, so a tile keeps sums for the labels that occur in it, and the
cost does not depend on how many labels there are.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import LANES, PIXELS, keep_lanes, lanes_at, plus
from liftcore.raster.cpu.lanes_halves import lowest_half, without_lowest
from liftcore.raster.cpu.walk import CHECK_EVERY, blend, look, meets, new_rays, next_splat, place_of, start_rays

_SLOTS = 32  # labels of a tile that there is room for at first


@kernel
def strongest_tiles(first, last, frame, labels, count, image):
    """The label of the largest sum on every ray of tiles ``first..last``; equal sums go to the smallest label.

    Args:
        labels: [P] i32 in -1..count - 1; -1 is a label like the others. image: [H, W] i32, filled with -1 before.
    """
    rays = new_rays(frame)
    slot_of = np.full(count + 1, -1, np.int32)
    label_of = np.empty(count + 1, np.int32)
    sums = np.zeros(_SLOTS * PIXELS, np.float32)
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays, frame, tile)
        slots = 0
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
                break
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            label = labels[frame.ids[frame.items[step]]]
            slot = slot_of[label + 1]
            if slot < 0:
                slot = slots
                slots += 1
                slot_of[label + 1] = slot
                label_of[slot] = label
                if slots * PIXELS > sums.shape[0]:
                    sums = np.concatenate((sums, np.zeros_like(sums)))
            halves = meets(rays, splat)
            while halves:
                half = lowest_half(halves)
                halves = without_lowest(halves)
                at = slot * PIXELS + half * LANES
                keep_lanes(sums, at, plus(lanes_at(sums, at), blend(rays, splat, half)))
        _read_off(sums, slots, label_of, (x0, y0), image)
        for slot in range(slots):
            slot_of[label_of[slot] + 1] = -1
        sums[: slots * PIXELS] = 0


@kernel
def _read_off(sums, slots, label_of, corner, image):
    """Write the winners of one tile, whose first pixel is ``corner`` (x, y), into the image."""
    x0, y0 = corner
    for y in range(min(TILE, image.shape[0] - y0)):
        for x in range(min(TILE, image.shape[1] - x0)):
            best, winner = np.float32(0.0), np.int32(-1)
            for slot in range(slots):
                total = sums[slot * PIXELS + place_of(y, x)]
                if total > best or (total == best and total > 0 and label_of[slot] < winner):
                    best, winner = total, label_of[slot]
            image[y0 + y, x0 + x] = winner
