"""Compositing of a tile's rays in Triton: one program per tile, a chunk of splats at a time.

The alphas of a chunk are independent and computed together. Then the splats are composited in order, near to far,
with a lane per pixel: ``w = alpha T``, ``T -= w``, as on the CPU (``cpu.simd``). The weights of the chunk are stored
in the program's scratch memory, from which a product loads them as a matrix. Scratch fits into the GPU's L1 and L2
caches, and threads synchronise only twice per chunk.

Scratch has PARTS parts of [CHUNK, 256] f32: alphas, weights and, where the total weight has other weights than the
product, the same for the total weight. Values that are read are overwritten only after a barrier, for any assignment
of pixels to threads. A tile's 256 pixels are numbered row by row.

A falloff is evaluated at a row, at a column's start in float64, and at a lane, the number of pixels from there on.
Terms that change from row to row are float64 and rounded once; along a row everything is float32, as most GPUs have
few float64 units.
"""

import triton.language as tl

from liftcore.raster.gpu import project as scene
from liftcore.raster.gpu.launching import jit
from liftcore.scene.compositing import ALPHA_FLOOR, LARGEST_EXPONENT, TILE
from liftcore.scene.splats import Kernel

GAUSSIANS, BETAS, DISCS = 0, 1, 2
KINDS = {Kernel.GAUSSIAN_3D: GAUSSIANS, Kernel.BETA: BETAS, Kernel.GAUSSIAN_2D: DISCS}
FLOORS = {Kernel.GAUSSIAN_3D: ALPHA_FLOOR, Kernel.BETA: 0.0, Kernel.GAUSSIAN_2D: ALPHA_FLOOR}
CHUNK = 16  # splats at a time; no smaller, for the matrix products
PART = CHUNK * TILE * TILE  # floats of a part of scratch
PARTS = 2  # of scratch; twice as many with those of the total weight

# The same as constants of kernels.
_CHUNK, _TILE, _PIXELS = tl.constexpr(CHUNK), tl.constexpr(TILE), tl.constexpr(TILE * TILE)
_WEIGHTS, _UNSCALED_ALPHAS = tl.constexpr(PART), tl.constexpr(2 * PART)
_BETAS = tl.constexpr(BETAS)
_DISCS = tl.constexpr(DISCS)
_LARGEST_EXPONENT = tl.constexpr(LARGEST_EXPONENT)
_SMALLEST_REST = tl.constexpr(2.0**-100)  # lower bound of 1 - sigma before its logarithm
_LOG2_E = tl.constexpr(1.4426950408889634)
_PLACE, _INK = tl.constexpr(scene.PLACE), tl.constexpr(scene.INK)
_OPACITY, _UNSCALED_OPACITY = tl.constexpr(scene.OPACITY), tl.constexpr(scene.UNSCALED_OPACITY)
_MX, _MY = tl.constexpr(scene.MX), tl.constexpr(scene.MY)  # of discs too: the projected centre
_SLOPE, _C = tl.constexpr(scene.SLOPE), tl.constexpr(scene.C)
_A, _BETA = tl.constexpr(scene.A), tl.constexpr(scene.BETA)
_S_X, _S_Y = tl.constexpr(scene.S_X), tl.constexpr(scene.S_Y)
_T_X, _T_Y = tl.constexpr(scene.T_X), tl.constexpr(scene.T_Y)
_D_ZERO, _D_X, _D_Y = tl.constexpr(scene.D_ZERO), tl.constexpr(scene.D_X), tl.constexpr(scene.D_Y)
_S_STEP, _T_STEP, _D_STEP = tl.constexpr(scene.S_STEP), tl.constexpr(scene.T_STEP), tl.constexpr(scene.D_STEP)


@jit
def falloff_at(places, inks, item, inside, y, x, lane, KIND: tl.constexpr):
    """Return 2^-e at pixel centres; 0 outside the kernel's support.

    Args:
        places: [n, PLACE] f64. inks: [n, INK] f32. item: rows of both; inside: mask of valid rows.
        y: f64, centre of the pixel's row. x: f64, centre of the column at lane 0. lane: f32.
    """
    place = places + item * _PLACE
    ink = inks + item * _INK
    dx = x - tl.load(place + _MX, mask=inside, other=0.0)
    dy = y - tl.load(place + _MY, mask=inside, other=0.0)
    a = tl.load(ink + _A, mask=inside, other=0.0)
    if KIND == _DISCS:
        u = dx.to(tl.float32) + lane
        nearby = a * u * u + (a.to(tl.float64) * dy * dy).to(tl.float32)
        s = _form(place + _S_X, place + _S_Y, ink + _S_STEP, inside, dx, dy, 0.0, lane)
        t = _form(place + _T_X, place + _T_Y, ink + _T_STEP, inside, dx, dy, 0.0, lane)
        at_centre = tl.load(place + _D_ZERO, mask=inside, other=-1.0)
        d = _form(place + _D_X, place + _D_Y, ink + _D_STEP, inside, dx, dy, at_centre, lane)
        crossing = (s * s + t * t) / (d * d)
        # Where the ray misses the plane the quotient may be NaN; the low-pass applies then.
        return tl.exp2(-tl.where((d > 0.0) & (crossing < nearby), crossing, nearby))
    slope = tl.load(place + _SLOPE, mask=inside, other=0.0)
    c = tl.load(place + _C, mask=inside, other=0.0)
    u = (dx - slope * dy).to(tl.float32) + lane
    e = a * u * u + (c * dy * dy).to(tl.float32)
    if KIND == _BETAS:
        # The rounding of 1 - sigma is corrected after the logarithm.
        within = e < 1.0
        rest = tl.maximum(tl.where(within, 1.0 - e, 1.0), _SMALLEST_REST)
        rounding = (1.0 - rest) - e
        beta = tl.load(ink + _BETA, mask=inside, other=1.0)
        exponent = -beta * (tl.log2(rest) + rounding * _LOG2_E)
        hit = within & (exponent < _LARGEST_EXPONENT)
        return tl.where(hit, tl.exp2(-tl.where(hit, exponent, 0.0)), 0.0)
    return tl.exp2(-e)


@jit
def _form(by_x, by_y, step, inside, dx, dy, at_centre, lane):
    """Return ``at_centre + by_x dx + by_y dy`` along a row, from float32 values and their rounding errors.

    A step has 19 bits, so that its product with a lane is exact, and a disc seen nearly edge-on, whose forms change
    by thousands per pixel, keeps its precision where they are small.
    """
    start = at_centre + tl.load(by_x, mask=inside, other=0.0) * dx + tl.load(by_y, mask=inside, other=0.0) * dy
    rounded = start.to(tl.float32)
    rest = (start - rounded.to(tl.float64)).to(tl.float32)
    coarse = tl.load(step, mask=inside, other=0.0)
    fine = tl.load(step + 1, mask=inside, other=0.0)
    return (rounded + coarse * lane) + (rest + fine * lane)


@jit
def start_rays(tile, columns, width, height):
    """Return T [256] f32: 1 for every ray of a tile inside the image, 0 for the others."""
    pixel = tl.arange(0, _PIXELS)
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    return tl.where((x < width) & (y < height), 1.0, 0.0)


@jit
def fill_alphas(
    places, inks, items, at, last, tile, columns, scratch, cap, floor, KIND: tl.constexpr, WITH_UNSCALED: tl.constexpr
):
    """Store the alphas of a chunk of items from ``at`` on; WITH_UNSCALED: those of unscaled opacity too."""
    number = tl.arange(0, _CHUNK)[:, None, None]
    row = tl.arange(0, _TILE)[None, :, None]
    column = tl.arange(0, _TILE)[None, None, :]
    inside = at + number < last
    item = tl.load(items + at + number, mask=inside, other=0)
    y = (tile // columns * _TILE + row).to(tl.float64) + 0.5
    x = (tile % columns * _TILE).to(tl.float64) + 0.5
    falloff = falloff_at(places, inks, item, inside, y, x, column.to(tl.float32), KIND)
    target = scratch + number * _PIXELS + row * _TILE + column
    opacity = tl.load(inks + item * _INK + _OPACITY, mask=inside, other=0.0)
    alpha = opacity * falloff
    tl.store(target, tl.where(alpha >= floor, tl.minimum(alpha, cap), 0.0))
    if WITH_UNSCALED:
        opacity = tl.load(inks + item * _INK + _UNSCALED_OPACITY, mask=inside, other=0.0)
        alpha = opacity * falloff
        tl.store(target + _UNSCALED_ALPHAS, tl.where(alpha >= floor, tl.minimum(alpha, cap), 0.0))
    tl.debug_barrier()


@jit
def blend(alpha, transmittance, stop):
    """Return one splat's weights on rays of a transmittance, and the transmittance behind it (paper Eq. 1).

    A ray whose next transmittance would be at or below the stop gets no weight and terminates.
    """
    weight = alpha * transmittance
    after = transmittance - weight  # T (1 - alpha) would round 1 - alpha to 1 for faint splats
    active = weight < transmittance - stop  # as on the CPU: opaque splats often leave exactly the stop
    return tl.where(active, weight, 0.0), tl.where(active, after, 0.0)


@jit
def blend_chunk(scratch, transmittance, stop, count):
    """Store the weights of a chunk's first ``count`` alphas in scratch; return the transmittance behind them."""
    pixel = tl.arange(0, _PIXELS)
    for number in range(tl.minimum(count, _CHUNK)):
        pointer = scratch + number * _PIXELS + pixel
        weight, transmittance = blend(tl.load(pointer), transmittance, stop)
        tl.store(pointer + _WEIGHTS, weight)
    tl.debug_barrier()
    return transmittance


@jit
def weights_of(scratch, count, pixel):
    """Load the weights [CHUNK, n] f32 of a chunk of ``count`` splats on some pixels [n]."""
    number = tl.arange(0, _CHUNK)[:, None]
    pointer = scratch + _WEIGHTS + number * _PIXELS + pixel[None, :]
    return tl.load(pointer, mask=number < count, other=0.0)
