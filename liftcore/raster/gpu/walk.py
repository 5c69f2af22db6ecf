"""The walk of a tile's rays, in Triton: one program a tile, a chunk of splats at a time.

A chunk's alphas are made together, for nothing in them waits for anything. Then the splats pass the rays one by one,
near to far, each pixel a lane: ``w = alpha T``, ``T -= w``, as on the CPU and for its reasons (docs/stability.md).
The weights of the chunk are left in the program's own scratch, from where a product takes them as a matrix. Scratch
fits the card's nearest caches, and threads wait for one another only twice a chunk.

Scratch has PARTS parts of [CHUNK, 256] f32: alphas, weights and, where evidence has rays of its own or more weights
than count, the same of it. What is read is never written over before a barrier, however threads share the pixels.

A tile's 256 pixels are counted row by row.
"""

from __future__ import annotations

import triton.language as tl

from liftcore.raster.base import TILE
from liftcore.raster.gpu import scene
from liftcore.raster.gpu.falloffs import falloff_at
from liftcore.raster.gpu.launching import jit

CHUNK = 16  # splats at a time; no smaller, for the matrix products
PART = CHUNK * TILE * TILE  # floats of a part of scratch
PARTS = 2  # of scratch, twice as many with those of the evidence

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_INK = tl.constexpr(scene.INK)
_WEIGHTS, _PLAIN_ALPHAS = tl.constexpr(PART), tl.constexpr(2 * PART)
_OPACITY, _PLAIN = tl.constexpr(scene.OPACITY), tl.constexpr(scene.PLAIN)


@jit
def start_rays(tile, columns, width, height):
    """[256] f32: 1 for every ray of a tile that lies inside the image, 0 for the others."""
    pixel = tl.arange(0, _PIXELS)
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    return tl.where((x < width) & (y < height), 1.0, 0.0)


@jit
def fill_alphas(
    places, inks, items, at, last, tile, columns, scratch, cap, floor, KIND: tl.constexpr, PLAIN: tl.constexpr
):
    """The alphas of the chunk of items from ``at`` on, to scratch; with PLAIN those without the opacity gain too."""
    number = tl.arange(0, _CHUNK)[:, None, None]
    row = tl.arange(0, _TILE)[None, :, None]
    column = tl.arange(0, _TILE)[None, None, :]
    inside = at + number < last
    item = tl.load(items + at + number, mask=inside, other=0)
    y = (tile // columns * _TILE + row).to(tl.float64) + 0.5
    x = (tile % columns * _TILE).to(tl.float64) + 0.5
    falloff = falloff_at(places, inks, item, inside, y, x, column.to(tl.float32), KIND)
    own = scratch + number * _PIXELS + row * _TILE + column
    opacity = tl.load(inks + item * _INK + _OPACITY, mask=inside, other=0.0)
    alpha = opacity * falloff
    tl.store(own, tl.where(alpha >= floor, tl.minimum(alpha, cap), 0.0))
    if PLAIN:
        opacity = tl.load(inks + item * _INK + _PLAIN, mask=inside, other=0.0)
        alpha = opacity * falloff
        tl.store(own + _PLAIN_ALPHAS, tl.where(alpha >= floor, tl.minimum(alpha, cap), 0.0))
    tl.debug_barrier()


@jit
def blend(alpha, light, stop):
    """One splat's weights on rays with ``light`` left, and the light after it (paper Eq. 1).

    A ray whose next light would be at or below the stop takes nothing and is done.
    """
    weight = alpha * light
    after = light - weight  # 1 - alpha would be rounded first, and a million faint splats be lost
    lit = weight < light - stop  # to the bit what the CPU's lanes ask: opaque splats often leave just the stop
    return tl.where(lit, weight, 0.0), tl.where(lit, after, 0.0)


@jit
def blend_chunk(scratch, light, stop, count):
    """The weights of the first ``count`` alphas of a chunk, to scratch; the light after it."""
    pixel = tl.arange(0, _PIXELS)
    for number in range(tl.minimum(count, _CHUNK)):
        own = scratch + number * _PIXELS + pixel
        weight, light = blend(tl.load(own), light, stop)
        tl.store(own + _WEIGHTS, weight)
    tl.debug_barrier()
    return light


@jit
def weights_of(scratch, count, pixel):
    """[CHUNK, n] f32, the weights of a chunk of ``count`` on some pixels [n]."""
    number = tl.arange(0, _CHUNK)[:, None]
    own = scratch + _WEIGHTS + number * _PIXELS + pixel[None, :]
    return tl.load(own, mask=number < count, other=0.0)
