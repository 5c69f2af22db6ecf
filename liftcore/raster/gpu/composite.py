"""The rays of a tile, in Triton: one program a tile, a chunk of splats at a time.

A chunk's alphas are made together, for nothing in them waits for anything. Then the splats pass the rays one by one,
near to far, each pixel a lane: ``w = alpha T``, ``T -= w``, as on the CPU and for its reasons (``cpu.composite``).
The weights of the chunk are left in the program's own scratch, from where a product takes them as a matrix. Scratch
fits the card's nearest caches, and threads wait for one another only twice a chunk.

Scratch has PARTS parts of [CHUNK, 256] f32: alphas, weights and, where total weight has rays of its own or more
weights than count, the same of it. What is read is never written over before a barrier, however threads share the
pixels. A tile's 256 pixels are counted row by row.

A falloff is taken at a row, a column's start in float64, and a lane, the whole pixels from there on. What changes
from row to row is taken in float64 and rounded once; along a row a pixel costs float32 only, for most cards have few
float64 units.
"""

import triton.language as tl

from liftcore.raster.cpu.composite import CENTRAL, FRONT, LARGEST
from liftcore.raster.gpu import project as scene
from liftcore.raster.gpu.launching import jit, lang
from liftcore.scene.compositing import ALPHA_FLOOR, LARGEST_EXPONENT, TILE
from liftcore.scene.splats import Kernel

GAUSSIANS, BETAS, DISCS = 0, 1, 2
KINDS = {Kernel.GAUSSIAN_3D: GAUSSIANS, Kernel.BETA: BETAS, Kernel.GAUSSIAN_2D: DISCS}
FLOORS = {Kernel.GAUSSIAN_3D: ALPHA_FLOOR, Kernel.BETA: 0.0, Kernel.GAUSSIAN_2D: ALPHA_FLOOR}
CHUNK = 16  # splats at a time; no smaller, for the matrix products
PART = CHUNK * TILE * TILE  # floats of a part of scratch
PARTS = 2  # of scratch, twice as many with those of the total weight

# What kernels read of all this.
_CHUNK, _TILE, _PIXELS = tl.constexpr(CHUNK), tl.constexpr(TILE), tl.constexpr(TILE * TILE)
_SCRATCH, _EVIDENCE = tl.constexpr(PARTS * PART), tl.constexpr(PARTS * PART)
_WEIGHTS, _PLAIN_ALPHAS = tl.constexpr(PART), tl.constexpr(2 * PART)
_LARGEST, _FRONT, _CENTRAL = tl.constexpr(LARGEST), tl.constexpr(FRONT), tl.constexpr(CENTRAL)
_LATER = tl.constexpr(1 << 30)  # above every number of an item: a place that is still free
_BETAS = tl.constexpr(BETAS)
_DISCS = tl.constexpr(DISCS)
_LARGEST_EXPONENT = tl.constexpr(LARGEST_EXPONENT)
_SMALLEST_REST = tl.constexpr(2.0**-100)  # of 1 - sigma, where its logarithm is taken
_LOG2_E = tl.constexpr(1.4426950408889634)
_PLACE, _INK = tl.constexpr(scene.PLACE), tl.constexpr(scene.INK)
_OPACITY, _PLAIN = tl.constexpr(scene.OPACITY), tl.constexpr(scene.PLAIN)
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
        met = within & (exponent < _LARGEST_EXPONENT)
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


@jit
def blend_chosen(
    scratch, light, stop, count, least, room, light_in_front, SELECTION: tl.constexpr, PLAIN: tl.constexpr
):
    """``blend_chunk`` that leaves only weights that count, and with PLAIN all of them as the total weight's.

    Args:
        least: [256] f32, of top-k: the k-th largest weight of a ray; room: [256] i32, how many that equal it count.
        light_in_front: of front-mass: a weight counts while the light before it is above this.

    Returns:
        The light after the chunk, and the room that is left.
    """
    pixel = tl.arange(0, _PIXELS)
    for number in range(tl.minimum(count, _CHUNK)):
        own = scratch + number * _PIXELS + pixel
        before = light
        weight, light = blend(tl.load(own), light, stop)
        if PLAIN:
            tl.store(own + _EVIDENCE + _WEIGHTS, weight)
        if SELECTION == _LARGEST:  # equal ones near to far, until k are full
            equal = (weight == least) & (weight > 0.0) & (room > 0)
            room -= equal.to(tl.int32)
            tl.store(own + _WEIGHTS, tl.where(equal | (weight > least), weight, 0.0))
        else:
            tl.store(own + _WEIGHTS, tl.where(before > light_in_front, weight, 0.0))
    tl.debug_barrier()
    return light, room


@jit
def counted(
    weights, pixel, places, items, at, last, tile, columns, smallest, SELECTION: tl.constexpr, POWER: tl.constexpr
):
    """A chunk's weights [CHUNK, n] on pixels [n] to their power; none too small or off the centre."""
    weights = tl.where(weights >= smallest, weights, 0.0)
    if SELECTION == _CENTRAL:
        number = at + tl.arange(0, _CHUNK)
        inside = number < last
        place = places + tl.load(items + number, mask=inside, other=0) * _PLACE
        column = tl.floor(tl.load(place, mask=inside, other=-1.0)) - (tile % columns * _TILE).to(tl.float64)
        row = tl.floor(tl.load(place + 1, mask=inside, other=-1.0)) - (tile // columns * _TILE).to(tl.float64)
        own = (column[:, None] == (pixel % _TILE).to(tl.float64)[None, :]) & (
            row[:, None] == (pixel // _TILE).to(tl.float64)[None, :]
        )
        weights = tl.where(own, weights, 0.0)
    if POWER == 0:
        weights = tl.where(weights > 0.0, 1.0, 0.0)
    if POWER == 2:
        weights = weights * weights
    return weights


@jit
def rank_tile(
    places, inks, starts, items, scratch, largest, band_tile, own_tile, columns, width, height, count,
    cap, stop, floor, KIND: tl.constexpr, COUNT: tl.constexpr,
):  # fmt: skip
    own = own_tile + tl.program_id(0)
    tile = band_tile + own
    mine = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    rank = tl.arange(0, COUNT)
    first = tl.load(starts + own)
    at = first
    last = tl.load(starts + own + 1)
    light = start_rays(tile, columns, width, height)
    # The rest of a power of two is filled with what nothing displaces.
    held = tl.where((rank < count)[None, :] & (pixel >= 0)[:, None], 0.0, float("inf"))
    order = _LATER + rank[None, :] + tl.zeros([_PIXELS, COUNT], tl.int32)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        known = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
        light = blend_chunk(mine, light, stop, known)
        for number in range(tl.minimum(known, _CHUNK)):
            weight = tl.load(mine + _WEIGHTS + number * _PIXELS + pixel)
            least = lang.min(held, 1)
            # Of equal ones the last that came makes room.
            latest = lang.max(tl.where(held == least[:, None], order, -1), 1)
            displaced = (order == latest[:, None]) & (weight > least)[:, None]
            held = tl.where(displaced, weight[:, None], held)
            order = tl.where(displaced, (at - first).to(tl.int32) + number, order)
        lit = lang.max(light, 0)
        at += _CHUNK
    to = (tl.program_id(0) * _PIXELS + pixel)[:, None] * count + rank[None, :]
    tl.store(largest + to, held, mask=(rank < count)[None, :] & (pixel >= 0)[:, None])
