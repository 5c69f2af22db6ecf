"""The footprint of a splat at a point, in Triton: the falloff of every kernel, before opacity, cap and floor.

A point is given as its row, a column's start in float64, and a lane, the whole pixels from there on. What changes
from row to row is taken in float64 and rounded once; along a row a pixel costs float32 only, for most cards have few
float64 units. All arguments broadcast, so the same code serves a chunk of splats on a tile and one splat on a ray.
"""

from __future__ import annotations

import triton.language as tl

from liftcore.raster.base import ALPHA_FLOOR, LARGEST_EXPONENT
from liftcore.raster.gpu import scene
from liftcore.raster.gpu.launching import jit
from liftcore.scene.splats import Kernel

GAUSSIANS, BETAS, DISCS = 0, 1, 2
KINDS = {Kernel.GAUSSIAN_3D: GAUSSIANS, Kernel.BETA: BETAS, Kernel.GAUSSIAN_2D: DISCS}
FLOORS = {Kernel.GAUSSIAN_3D: ALPHA_FLOOR, Kernel.BETA: 0.0, Kernel.GAUSSIAN_2D: ALPHA_FLOOR}

_BETAS = tl.constexpr(BETAS)
_DISCS = tl.constexpr(DISCS)
_LARGEST = tl.constexpr(LARGEST_EXPONENT)
_SMALLEST_REST = tl.constexpr(2.0**-100)  # of 1 - sigma, where its logarithm is taken
_LOG2_E = tl.constexpr(1.4426950408889634)
_PLACE = tl.constexpr(scene.PLACE)
_INK = tl.constexpr(scene.INK)
_MX, _MY = tl.constexpr(scene.MX), tl.constexpr(scene.MY)  # of discs too: the projected centre
_SLOPE, _KY = tl.constexpr(scene.SLOPE), tl.constexpr(scene.KY)
_KX, _BETA = tl.constexpr(scene.KX), tl.constexpr(scene.BETA)
_S_X, _S_Y = tl.constexpr(scene.S_X), tl.constexpr(scene.S_Y)
_T_X, _T_Y = tl.constexpr(scene.T_X), tl.constexpr(scene.T_Y)
_D_ZERO, _D_X, _D_Y = tl.constexpr(scene.D_ZERO), tl.constexpr(scene.D_X), tl.constexpr(scene.D_Y)
_S_STEP, _T_STEP, _D_STEP = tl.constexpr(scene.S_STEP), tl.constexpr(scene.T_STEP), tl.constexpr(scene.D_STEP)


@jit
def falloff_at(places, inks, item, inside, y, x, lane, KIND: tl.constexpr):
    """2^-e at pixel centres; 0 where the kernel has none.

    Args:
        places: [n, PLACE] f64. inks: [n, INK] f32. item: rows of both; inside: whether there is such a row.
        y: f64, centre of the pixel's row. x: f64, centre of the column at lane 0. lane: f32.
    """
    place = places + item * _PLACE
    ink = inks + item * _INK
    dx = x - tl.load(place + _MX, mask=inside, other=0.0)
    dy = y - tl.load(place + _MY, mask=inside, other=0.0)
    kx = tl.load(ink + _KX, mask=inside, other=0.0)
    if KIND == _DISCS:
        u = dx.to(tl.float32) + lane
        nearby = kx * u * u + (kx.to(tl.float64) * dy * dy).to(tl.float32)
        s = _form(place + _S_X, place + _S_Y, ink + _S_STEP, inside, dx, dy, 0.0, lane)
        t = _form(place + _T_X, place + _T_Y, ink + _T_STEP, inside, dx, dy, 0.0, lane)
        at_centre = tl.load(place + _D_ZERO, mask=inside, other=-1.0)
        d = _form(place + _D_X, place + _D_Y, ink + _D_STEP, inside, dx, dy, at_centre, lane)
        crossing = (s * s + t * t) / (d * d)
        # Where the ray misses the plane the quotient may be no number; the low-pass counts then.
        return tl.exp2(-tl.where((d > 0.0) & (crossing < nearby), crossing, nearby))
    slope = tl.load(place + _SLOPE, mask=inside, other=0.0)
    ky = tl.load(place + _KY, mask=inside, other=0.0)
    u = (dx - slope * dy).to(tl.float32) + lane
    e = kx * u * u + (ky * dy * dy).to(tl.float32)
    if KIND == _BETAS:
        # 1 - sigma is rounded for the logarithm, and what that lost is put back.
        within = e < 1.0
        rest = tl.maximum(tl.where(within, 1.0 - e, 1.0), _SMALLEST_REST)
        lost = (1.0 - rest) - e
        beta = tl.load(ink + _BETA, mask=inside, other=1.0)
        exponent = -beta * (tl.log2(rest) + lost * _LOG2_E)
        met = within & (exponent < _LARGEST)
        return tl.where(met, tl.exp2(-tl.where(met, exponent, 0.0)), 0.0)
    return tl.exp2(-e)


@jit
def _form(by_x, by_y, step, inside, dx, dy, at_centre, lane):
    """``at_centre + by_x dx + by_y dy`` along a row, of float32 values and the rests that they leave out.

    A step has 19 bits, so that its product with a lane is exact, and a disc seen nearly edge-on, whose forms change
    by thousands a pixel, keeps its digits where they are small.
    """
    start = at_centre + tl.load(by_x, mask=inside, other=0.0) * dx + tl.load(by_y, mask=inside, other=0.0) * dy
    rounded = start.to(tl.float32)
    rest = (start - rounded.to(tl.float64)).to(tl.float32)
    coarse = tl.load(step, mask=inside, other=0.0)
    fine = tl.load(step + 1, mask=inside, other=0.0)
    return (rounded + coarse * lane) + (rest + fine * lane)
