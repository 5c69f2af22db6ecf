"""``A X`` and what else is read off the rays: images, row sums, whole rows of A."""

from __future__ import annotations

import numpy as np

from liftcore.jit import kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.footprints import alpha_at
from liftcore.raster.cpu.lanes import LANES, PIXELS, in_all_lanes, keep_lanes, lanes_at, plus_product
from liftcore.raster.cpu.lanes_halves import lowest_half, without_lowest
from liftcore.raster.cpu.walk import CHECK_EVERY, blend, look, meets, new_rays, next_splat, place_of, start_rays


@kernel
def render_tiles(first, last, frame, values, image):
    """Composite ``values`` [P, C] f32 over tiles ``first..last`` into ``image`` [H, W, C] f32."""
    channels = values.shape[1]
    rays = new_rays(frame)
    sums = np.zeros(channels * PIXELS, np.float32)
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays, frame, tile)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
                break
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            number = frame.ids[frame.items[step]]
            halves = meets(rays, splat)
            while halves:
                half = lowest_half(halves)
                halves = without_lowest(halves)
                weights = blend(rays, splat, half)
                for channel in range(channels):
                    at = channel * PIXELS + half * LANES
                    value = in_all_lanes(values[number, channel])
                    keep_lanes(sums, at, plus_product(lanes_at(sums, at), weights, value))
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                for channel in range(channels):
                    image[y0 + y, x0 + x, channel] = sums[channel * PIXELS + place_of(y, x)]
        sums[:] = 0


@kernel
def trace_rays(frame, pixels):
    """Rows of A for single pixels, one ray at a time; alpha and T in float32, so that cut-offs fall as in the lanes.

    Args:
        pixels: [n, 2] i32, x and y.

    Returns:
        indptr [n + 1] i64, splats [nnz] i32 near to far, weights [nnz] f32.
    """
    indptr = np.zeros(pixels.shape[0] + 1, np.int64)
    splats = np.empty(1 << 12, np.int32)
    weights = np.empty(1 << 12, np.float32)
    count = 0
    floor, cap, stop = np.float32(frame.kernel.floor), np.float32(frame.cap), np.float32(frame.stop)
    for i in range(pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        tile = (y // TILE) * frame.columns + x // TILE
        light = np.float32(1.0)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            place = frame.items[step]
            alpha = np.float32(alpha_at(frame.kernel, frame.records[place], x + 0.5, y + 0.5))
            if alpha < floor or alpha == 0:
                continue
            weight = min(cap, alpha) * light
            if not weight < light - stop:
                break
            if count == splats.shape[0]:
                splats = np.concatenate((splats, np.empty_like(splats)))
                weights = np.concatenate((weights, np.empty_like(weights)))
            splats[count] = frame.ids[place]
            weights[count] = weight
            light -= weight
            count += 1
        indptr[i + 1] = count
    return indptr, splats[:count], weights[:count]
