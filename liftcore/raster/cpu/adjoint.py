"""``A^T Y``: what the pixels of an image give back to the splats, the transpose of the render.

Every tile share keeps one row of sums for each splat that it met: inside a tile eight lanes a channel, then one
number, added tile by tile. The shares' rows are added in the order of the shares, so no sum depends on the threads.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import LANES, PIXELS, keep_lanes, lanes_at, no_lanes, plus_product, sum_of_lanes
from liftcore.raster.cpu.lanes_halves import lowest_half, without_lowest
from liftcore.raster.cpu.walk import CHECK_EVERY, blend, look, meets, new_rays, next_splat, place_of, start_rays


@kernel
def gather_tiles(first, last, frame, image):
    """``A^T Y`` of tiles ``first..last`` for ``image`` [H, W, C] f32.

    Returns:
        places [n] i32, the records met, in the order of their first tile; sums [n, C] f32.
    """
    channels = image.shape[2]
    rays = new_rays(frame)
    pixels = np.zeros(channels * PIXELS, np.float32)  # the tile's part of the image, channel by channel
    lanes = np.zeros(channels * LANES, np.float32)
    rows = np.full(frame.ids.shape[0], -1, np.int32)  # the row of sums of a record
    size = 1 << 10
    places, sums = np.empty(size, np.int32), np.empty((size, channels), np.float32)
    count = 0
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays, frame, tile)
        _read_pixels(pixels, image, x0, y0)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
                break
            place = frame.items[step]
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            halves = meets(rays, splat)
            if not halves:
                continue
            while halves:
                half = lowest_half(halves)
                halves = without_lowest(halves)
                weights = blend(rays, splat, half)
                for channel in range(channels):
                    own = lanes_at(pixels, channel * PIXELS + half * LANES)
                    total = lanes_at(lanes, channel * LANES)
                    keep_lanes(lanes, channel * LANES, plus_product(total, weights, own))
            if rows[place] < 0:
                if count == places.shape[0]:
                    places, sums = np.concatenate((places, places)), np.concatenate((sums, sums))
                rows[place], places[count] = count, place
                sums[count] = 0
                count += 1
            _drain(lanes, sums, rows[place])
    return places[:count], sums[:count]


@inlined
def _read_pixels(pixels, image, x0, y0):
    """The 16 x 16 pixels from (x0, y0) on; zero outside the image, where no ray walks."""
    height, width, channels = image.shape
    pixels[:] = 0
    for y in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            for channel in range(channels):
                pixels[channel * PIXELS + place_of(y, x)] = image[y0 + y, x0 + x, channel]


@inlined
def _drain(lanes, sums, row):
    """Add the eight lanes of every channel to the row; the lanes are zero afterwards."""
    for channel in range(sums.shape[1]):
        sums[row, channel] += sum_of_lanes(lanes_at(lanes, channel * LANES))
        keep_lanes(lanes, channel * LANES, no_lanes())


@kernel
def add_sums(first, last, share, ids, result, begin):
    """Add a tile share's rows whose records lie in ``first..last`` to ``result`` [P, F] f32, from channel ``begin``.

    ``share = (places, sums)`` of ``gather_tiles``; ids: [P] i32, the splat of each record.
    """
    places, sums = share
    for i in range(places.shape[0]):
        if first <= places[i] < last:
            splat = ids[places[i]]
            for channel in range(sums.shape[1]):
                result[splat, begin + channel] += sums[i, channel]
