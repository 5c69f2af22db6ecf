"""``A X`` and what else is read off the rays: images, row sums, the largest weights, whole rows of A."""

from __future__ import annotations

import numpy as np

from liftcore.jit import kernel
from liftcore.lanes import LANES, PIXELS, WEIGHTS, add_scaled_lanes
from liftcore.raster.constants import TILE
from liftcore.raster.footprints import alpha_at, footprint, row_of, touches
from liftcore.raster.walk import CHECK_EVERY, blend, look, new_rays, start_rays


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
            place = frame.items[step]
            splat = footprint(frame.kernel, frame.records, place, float(x0), float(y0))
            number = frame.ids[place]
            for row in range(splat.top, splat.bottom + 1):
                line = row_of(splat, row)
                for side in range(2):
                    half = 2 * row + side
                    if not rays.alive[half] or not touches(splat, line, side):
                        continue
                    blend(rays, splat, line, half)
                    offset = half * LANES
                    for channel in range(channels):
                        target = channel * PIXELS + offset
                        add_scaled_lanes(sums, target, rays.state, WEIGHTS + offset, values[number, channel])
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                for channel in range(channels):
                    image[y0 + y, x0 + x, channel] = sums[channel * PIXELS + y * TILE + x]
        sums[:] = 0


@kernel
def top_tiles(first, last, frame, ids, weights):
    """The largest weights of every ray of tiles ``first..last``, descending.

    Args:
        ids: [H, W, K] i32, filled with -1 before. weights: [H, W, K] f32, filled with 0 before.
    """
    count = ids.shape[2]
    rays = new_rays(frame)
    for tile in range(first, last):
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays, frame, tile)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
                break
            place = frame.items[step]
            splat = footprint(frame.kernel, frame.records, place, float(x0), float(y0))
            number = frame.ids[place]
            for row in range(splat.top, splat.bottom + 1):
                line = row_of(splat, row)
                for side in range(2):
                    half = 2 * row + side
                    if not rays.alive[half] or not touches(splat, line, side):
                        continue
                    blend(rays, splat, line, half)
                    for lane in range(LANES):
                        weight = rays.state[WEIGHTS + half * LANES + lane]
                        if weight <= 0:
                            continue
                        y, x = y0 + row, x0 + side * LANES + lane
                        k = count
                        while k > 0 and weights[y, x, k - 1] < weight:
                            if k < count:
                                weights[y, x, k] = weights[y, x, k - 1]
                                ids[y, x, k] = ids[y, x, k - 1]
                            k -= 1
                        if k < count:
                            weights[y, x, k] = weight
                            ids[y, x, k] = number


@kernel
def trace_rays(frame, pixels):
    """Rows of A for single pixels, one ray at a time; alpha and T in float32, so that cut-offs fall as in the lanes.

    Args:
        pixels: [n, 2] i32, x and y.

    Returns:
        row_starts [n + 1] i64, splats [nnz] i32 near to far, weights [nnz] f32.
    """
    row_starts = np.zeros(pixels.shape[0] + 1, np.int64)
    splats = np.empty(1 << 12, np.int32)
    weights = np.empty(1 << 12, np.float32)
    count = 0
    one, floor = np.float32(1.0), np.float32(frame.kernel.floor)
    cap, stop = np.float32(frame.cap), np.float32(frame.stop)
    for i in range(pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        tile = (y // TILE) * frame.columns + x // TILE
        light = one
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            place = frame.items[step]
            alpha = min(cap, np.float32(alpha_at(frame.kernel, frame.records[place], x + 0.5, y + 0.5)))
            if alpha < floor or alpha == 0:
                continue
            after = light * (one - alpha)
            if after <= stop:
                break
            if count == splats.shape[0]:
                splats = np.concatenate((splats, np.empty_like(splats)))
                weights = np.concatenate((weights, np.empty_like(weights)))
            splats[count] = frame.ids[place]
            weights[count] = alpha * light
            light = after
            count += 1
        row_starts[i + 1] = count
    return row_starts, splats[:count], weights[:count]
