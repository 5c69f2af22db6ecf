"""Compositing of a tile's splats, front to back, and the products of A that render images and single rays.

A tile has 32 row segments of eight pixels. Every product iterates over the segments that a splat ``meets``, calls
``blend`` and uses the weights at once, while they are in a register.

The first part has the code of each splat kernel: a class for the view's constants, one for a splat relative to a
tile, and four functions. numba compiles each for the class of its first argument, so a product is compiled once per
kernel in use and pays nothing for the others.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba.extending import overload

from liftcore.raster.cpu.project import (
    BETA,
    CENTRE_X,
    CENTRE_Y,
    CUTOFF,
    D_X,
    D_Y,
    D_ZERO,
    MX,
    MY,
    NEARBY,
    NEG_LOG2_OPACITY,
    OPACITY,
    S_X,
    S_Y,
    SLOPE,
    SQRT_A,
    T_X,
    T_Y,
    UNSCALED_OPACITY,
    C,
    View,
    low_pass_curvature,
)
from liftcore.raster.cpu.simd import (
    BASES,
    LANES,
    PIXELS,
    ROWS,
    SEGMENTS,
    STARTS,
    TRANSMITTANCE,
    UNSCALED_TRANSMITTANCE,
    BetaSegment,
    DiscSegment,
    GaussianSegment,
    active_segments,
    any_above,
    blend_lanes,
    blend_twice,
    ellipse_segments,
    fetch_row,
    in_all_lanes,
    lanes_at,
    larger,
    lowest,
    new_state,
    no_lanes,
    plus,
    plus_product,
    smaller,
    store_lanes,
    where_above,
    where_equal,
    without_lowest,
)
from liftcore.runtime.jit import inlined, kernel
from liftcore.scene.compositing import ALPHA_FLOOR, TILE
from liftcore.scene.kernel import Kernel

if TYPE_CHECKING:
    from collections.abc import Callable

_PREFETCH = 8  # items of a tile's list by which splats are prefetched: they are scattered in memory
CHECK_EVERY = 16  # splats between two updates of the active segments
_SPLITTER = 2.0**32 + 1.0  # leaves 21 of a float64's 53 bits: three fewer than float32, for products with lanes 0..7


# --------------------------------------------------------------------------------------------- A splat of each kernel


class Gaussians(NamedTuple):
    """3DGS: ``alpha = opacity 2^-e``."""

    floor: float  # a smaller alpha is zero


class Betas(NamedTuple):
    """DBS: ``alpha = opacity (1 - sigma)^beta``; its support is compact, so it needs no alpha floor."""

    floor: float


class Discs(NamedTuple):
    """2DGS: ``alpha = opacity 2^-e``, e from the intersection of ray and disc plane, or from the low-pass."""

    floor: float
    curvature: float  # of the low-pass: e = curvature |p - mu|^2, per px^2 of the view


class TileGaussian(NamedTuple):
    """A projected splat relative to the tile's first pixel centre."""

    mx: float
    my: float
    slope: float
    sqrt_a: float
    c: float
    cutoff: float
    opacity: float
    unscaled_opacity: float  # the opacity without the scale of logits
    neg_log2_opacity: float


class TileBeta(NamedTuple):
    """A projected DBS splat: as ``TileGaussian``, with the exponent of its falloff."""

    mx: float
    my: float
    slope: float
    sqrt_a: float
    c: float
    cutoff: float
    opacity: float
    unscaled_opacity: float
    neg_log2_opacity: float
    beta: float


class TileDisc(NamedTuple):
    """A disc: an outline around all its crossings, and a small circle for the low-pass."""

    mx: float  # the projected centre
    my: float
    outline_x: float  # centre of the outline
    outline_y: float
    slope: float
    sqrt_a: float
    c: float
    cutoff: float
    opacity: float
    unscaled_opacity: float
    neg_log2_opacity: float
    nearby: float  # px, radius of the circle
    near_root: float  # square root of the low-pass's curvature
    s_x: float  # s, t and d per pixel, relative to the projected centre
    s_y: float
    t_x: float
    t_y: float
    d_zero: float
    d_x: float
    d_y: float


def kernel_in(view: View, kind: Kernel) -> Gaussians | Betas | Discs:
    """Return the kernel's constants in a view; their class selects the compiled code."""
    if kind is Kernel.GAUSSIAN_2D:
        return Discs(ALPHA_FLOOR, low_pass_curvature(view))
    return Betas(0.0) if kind is Kernel.BETA else Gaussians(ALPHA_FLOOR)


def tile_splat(kernel, projected, row, x0, y0) -> Any:
    """Return a projected splat relative to the tile whose first pixel is (x0, y0)."""


def segments_of(splat, state) -> Any:
    """Return the set of the tile's segments that can have a weight; store the input of ``shape_of`` in ``state``."""


def shape_of(splat, state, segment) -> Any:
    """Return the splat's coefficients on a segment of ``segments_of``, for the blending of ``simd``."""


def circle_of(kernel, splat) -> Any:
    """Return centre x, y and radius, px, of a circle covered beside the outline; a radius below 0 means none."""


def _tile_gaussian(kernel, projected, row, x0, y0):
    splat = projected[row]
    return TileGaussian(
        splat[MX] - x0 - 0.5, splat[MY] - y0 - 0.5, splat[SLOPE], splat[SQRT_A], splat[C], splat[CUTOFF],
        splat[OPACITY], splat[UNSCALED_OPACITY], splat[NEG_LOG2_OPACITY],
    )  # fmt: skip


def _tile_beta(kernel, projected, row, x0, y0):
    splat = projected[row]
    return TileBeta(
        splat[MX] - x0 - 0.5, splat[MY] - y0 - 0.5, splat[SLOPE], splat[SQRT_A], splat[C], splat[CUTOFF],
        splat[OPACITY], splat[UNSCALED_OPACITY], splat[NEG_LOG2_OPACITY], splat[BETA],
    )  # fmt: skip


def _tile_disc(kernel, projected, row, x0, y0):
    splat = projected[row]
    return TileDisc(
        splat[CENTRE_X] - x0 - 0.5, splat[CENTRE_Y] - y0 - 0.5, splat[MX] - x0 - 0.5, splat[MY] - y0 - 0.5,
        splat[SLOPE], splat[SQRT_A], splat[C], splat[CUTOFF], splat[OPACITY], splat[UNSCALED_OPACITY],
        splat[NEG_LOG2_OPACITY], splat[NEARBY], math.sqrt(kernel.curvature),
        splat[S_X], splat[S_Y], splat[T_X], splat[T_Y], splat[D_ZERO], splat[D_X], splat[D_Y],
    )  # fmt: skip


def _ellipse_segments(splat, state):
    return ellipse_segments(state, (splat.mx, splat.my), splat.slope, (splat.sqrt_a, splat.c), splat.cutoff)


def _disc_segments(splat, state):
    outline = (splat.outline_x, splat.outline_y), splat.slope, (splat.sqrt_a, splat.c)
    within = ellipse_segments(state, *outline, splat.cutoff)
    squared = splat.nearby * splat.nearby if splat.nearby >= 0 else -1.0
    return within | ellipse_segments(state, (splat.mx, splat.my), 0.0, (1.0, 1.0), squared)


def _gaussian_shape(splat, state, segment):
    return GaussianSegment(state[STARTS + segment], np.float32(splat.sqrt_a), state[BASES + (segment & (ROWS - 1))])


@inlined
def _halved(value):
    """Return a float64 as a float32 and its rounding error."""
    rounded = np.float32(value)
    return rounded, np.float32(value - rounded)


@inlined
def _coarsened(value):
    """Split a float64 into a float32 of 21 bits, whose product with a lane is exact, and the rest (Veltkamp)."""
    large = _SPLITTER * value
    coarse = np.float32(large - (large - value))
    return coarse, np.float32(value - coarse)


def _beta_shape(splat, state, segment):
    dx, dy = segment // ROWS * LANES - splat.mx, segment % ROWS - splat.my
    start, start_rest = _halved(splat.sqrt_a * (dx - splat.slope * dy))
    root, root_rest = _coarsened(splat.sqrt_a)
    return BetaSegment(start, start_rest, root, root_rest, np.float32(splat.c * dy * dy), np.float32(splat.beta))


def _disc_shape(splat, state, segment):
    dx, dy = segment // ROWS * LANES - splat.mx, segment % ROWS - splat.my
    s, s_rest = _halved(splat.s_x * dx + splat.s_y * dy)
    s_step, s_step_rest = _coarsened(splat.s_x)
    t, t_rest = _halved(splat.t_x * dx + splat.t_y * dy)
    t_step, t_step_rest = _coarsened(splat.t_x)
    d, d_rest = _halved(splat.d_zero + splat.d_x * dx + splat.d_y * dy)
    d_step, d_step_rest = _coarsened(splat.d_x)
    return DiscSegment(
        np.float32(splat.near_root * dx), np.float32(splat.near_root), np.float32((splat.near_root * dy) ** 2),
        s, s_rest, s_step, s_step_rest, t, t_rest, t_step, t_step_rest, d, d_rest, d_step, d_step_rest,
    )  # fmt: skip


def _no_circle(kernel, splat):
    return 0.0, 0.0, -1.0


def _disc_circle(kernel, splat):
    return splat[CENTRE_X], splat[CENTRE_Y], splat[NEARBY]


_BY_CLASS: dict[Callable, dict[type, Callable]] = {
    tile_splat: {Gaussians: _tile_gaussian, Betas: _tile_beta, Discs: _tile_disc},
    segments_of: {TileGaussian: _ellipse_segments, TileBeta: _ellipse_segments, TileDisc: _disc_segments},
    shape_of: {TileGaussian: _gaussian_shape, TileBeta: _beta_shape, TileDisc: _disc_shape},
    circle_of: {Gaussians: _no_circle, Betas: _no_circle, Discs: _disc_circle},
}


def _compile_by_class(function: Callable) -> None:
    """Have numba compile, in place of ``function``, the implementation for the class of its first argument."""

    def implementation(first, *rest):
        return _BY_CLASS[function][first.instance_class]

    overload(function, inline="always", strict=False)(implementation)


for _function in _BY_CLASS:
    _compile_by_class(_function)


# -------------------------------------------------------------------------------------------------- A tile's 256 rays


class Frame(NamedTuple):
    """One view, projected and binned."""

    kernel: Gaussians | Betas | Discs  # its class selects the kernel's functions, at compile time
    projected: np.ndarray  # [P, COLUMNS] f64, projected splats
    ids: np.ndarray  # [P] i32, the splat of a row; -1 for unused rows
    starts: np.ndarray  # [tiles + 1] i64, each tile's list in items
    items: np.ndarray  # [n] i32, rows of projected splats, near to far in each tile
    columns: int  # tiles a row
    rows: int  # rows of tiles
    width: int  # pixels
    height: int  # pixels
    alpha_cap: float
    transmittance_stop: float


class Rays(NamedTuple):
    """The state of a tile's 256 rays."""

    state: np.ndarray  # [STATE] f32, with the layout of liftcore.raster.cpu.simd
    active: np.ndarray  # [1] u64, the segments with a ray that has not terminated, scaled or unscaled


def new_rays(frame: Frame) -> Rays:
    """Allocate the state of one tile's rays."""
    state = new_state(frame.kernel.floor, frame.alpha_cap, frame.transmittance_stop)
    return Rays(state, np.zeros(1, np.uint64))


@inlined
def place_of(y, x):
    """Return the index of a pixel's ray among the 256 of its tile."""
    return (x // LANES * ROWS + y) * LANES + x % LANES


@inlined
def next_splat(frame, tile, step, x0, y0):
    """Return the splat of an item of a tile's list, and prefetch a later one."""
    if step + _PREFETCH < frame.starts[tile + 1]:
        fetch_row(frame.projected, frame.items[step + _PREFETCH])
    return tile_splat(frame.kernel, frame.projected, frame.items[step], x0, y0)


@kernel
def start_rays(state, x0, y0, width, height):
    """Set T = 1 for every ray of a tile inside the image, 0 outside."""
    for y in range(TILE):
        for x in range(TILE):
            inside = np.float32(x0 + x < width and y0 + y < height)
            state[TRANSMITTANCE + place_of(y, x)] = inside
            state[UNSCALED_TRANSMITTANCE + place_of(y, x)] = inside


@inlined
def update_active(rays, with_unscaled):
    """Refresh the set of active segments; return True if any ray is still active."""
    active = active_segments(rays.state, TRANSMITTANCE)
    if with_unscaled:
        active |= active_segments(rays.state, UNSCALED_TRANSMITTANCE)
    rays.active[0] = active
    return active != 0


@inlined
def meets(rays, splat):
    """Return the active segments where the splat can have a weight."""
    return segments_of(splat, rays.state) & rays.active[0]


@inlined
def blend(rays, splat, segment):
    """Composite the splat over a segment; return its weights, eight lanes."""
    return blend_lanes(
        rays.state, segment * LANES, shape_of(splat, rays.state, segment), np.float32(splat.neg_log2_opacity)
    )


@inlined
def blend_both(rays, splat, segment, with_unscaled):
    """Composite the splat; return scaled and unscaled weights, which are the same if ``with_unscaled`` is None.

    The two paths differ in the last digits, so code that compares weights for equality must use one of them.
    """
    if with_unscaled is None:
        scaled = blend(rays, splat, segment)
        return scaled, scaled
    shape = shape_of(splat, rays.state, segment)
    return blend_twice(
        rays.state, segment * LANES, shape, (np.float32(splat.opacity), np.float32(splat.unscaled_opacity))
    )


# --------------------------------------------------------------------------------------- The largest weights of a ray
#
# The k largest weights of a ray are known only at its end, so top-k composites every tile twice: ``rank_tile`` finds
# the k-th largest weight, which is the threshold of ``largest_weights``.


def new_marks(top_k: int) -> np.ndarray | None:
    """Allocate the result of the first pass of top-k for a tile's 256 rays, [(k + 1) * 256] f32.

    The rays' largest weights, then their second largest, and so on to the k-th, 0 for none; last the number of
    weights equal to a ray's k-th that belong to the k. None if all weights count (0).
    """
    return np.zeros((top_k + 1) * PIXELS, np.float32) if top_k else None


@kernel
def rank_tile(rays, frame, tile, marks, with_unscaled):
    """Composite a tile for the k largest weights of its rays, in the same arithmetic as ``weigh_tiles``."""
    x0 = float((tile % frame.columns) * TILE)
    y0 = float((tile // frame.columns) * TILE)
    start_rays(rays.state, int(x0), int(y0), frame.width, frame.height)
    splat_counts = np.zeros(SEGMENTS, np.int64)  # splats of each segment so far, an upper bound of its weights
    for place in range(marks.shape[0]):
        marks[place] = 0
    last = marks.shape[0] // PIXELS - 2
    for step in range(frame.starts[tile], frame.starts[tile + 1]):
        if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not update_active(rays, False):
            break
        splat = next_splat(frame, tile, step, x0, y0)
        segments = meets(rays, splat)
        while segments:
            segment = lowest(segments)
            segments = without_lowest(segments)
            weights = blend_both(rays, splat, segment, with_unscaled)[0]
            at = min(splat_counts[segment], last) * PIXELS + segment * LANES
            splat_counts[segment] += 1
            while at >= PIXELS and any_above(weights, lanes_at(marks, at)):
                above = lanes_at(marks, at - PIXELS)
                store_lanes(marks, at, larger(lanes_at(marks, at), smaller(above, weights)))
                at -= PIXELS
            if at < PIXELS:
                store_lanes(marks, at, larger(lanes_at(marks, at), weights))
    least = last * PIXELS
    for place in range(least + PIXELS):
        ray = place % PIXELS
        marks[least + PIXELS + ray] += np.float32(marks[place] == marks[least + ray])


@inlined
def largest_weights(weights, least, ties):
    """Return the weights of eight lanes that are among the k largest of their rays, zero for others.

    Args:
        least: the k-th largest weights of the rays. ties: the number of weights equal to these that still count.

    Returns:
        The weights, and the remaining number of ties.
    """
    none = no_lanes()
    equal = where_equal(weights, least, where_above(ties, none, weights))  # near to far, until k are full
    ties = plus(ties, where_above(equal, none, in_all_lanes(np.float32(-1.0))))
    return plus(where_above(weights, least, weights), equal), ties


# ------------------------------------------------------------------------------------------------- Images and rays
#
# Compiled functions whose output size is not known in advance return at the first tile that does not fit, and are
# called again from there with larger arrays.


def render_tiles(first: int, last: int, frame: Frame, values: np.ndarray, image: np.ndarray) -> None:
    """Composite ``values`` [P, C] f32 over tiles ``first..last`` into ``image`` [H, W, C] f32: ``A X``."""
    _render(first, last, frame, new_rays(frame), values, np.zeros(values.shape[1] * PIXELS, np.float32), image)


@kernel
def _render(first, last, frame, rays, values, sums, image):
    channels = values.shape[1]
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays.state, x0, y0, frame.width, frame.height)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not update_active(rays, False):
                break
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            number = frame.ids[frame.items[step]]
            segments = meets(rays, splat)
            while segments:
                segment = lowest(segments)
                segments = without_lowest(segments)
                weights = blend(rays, splat, segment)
                for channel in range(channels):
                    at = channel * PIXELS + segment * LANES
                    value = in_all_lanes(values[number, channel])
                    store_lanes(sums, at, plus_product(lanes_at(sums, at), weights, value))
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                for channel in range(channels):
                    image[y0 + y, x0 + x, channel] = sums[channel * PIXELS + place_of(y, x)]
        for at in range(sums.shape[0]):
            sums[at] = 0


def strongest_tiles(first: int, last: int, frame: Frame, labels: np.ndarray, count: int, image: np.ndarray) -> None:
    """Write ``argmax(A onehot(labels))`` of tiles ``first..last`` to ``image``; ties go to the smallest label.

    A splat adds to one column of the one-hot render only, so a tile has sums for the labels that occur in it, and the
    cost does not depend on the number of labels (paper, Post Aggregation Filtering).

    Args:
        labels: [P] i32 in -1..count - 1; -1 is a label like the others. image: [H, W] i32, filled with -1 before.
    """
    rays, slots = new_rays(frame), 32  # initial capacity, labels per tile
    slot_of, label_of = np.full(count + 1, -1, np.int32), np.empty(count + 1, np.int32)
    tile = first
    while tile < last:
        sums = np.zeros(slots * PIXELS, np.float32)
        tile = _strongest(tile, last, frame, rays, labels, slot_of, label_of, sums, image)
        slots *= 2


@kernel
def _strongest(first, last, frame, rays, labels, slot_of, label_of, sums, image):
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays.state, x0, y0, frame.width, frame.height)
        slots, full = 0, False
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not update_active(rays, False):
                break
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            label = labels[frame.ids[frame.items[step]]]
            slot = slot_of[label + 1]
            if slot < 0:
                full = (slots + 1) * PIXELS > sums.shape[0]
                if full:
                    break
                slot = slots
                slots += 1
                slot_of[label + 1] = slot
                label_of[slot] = label
            segments = meets(rays, splat)
            while segments:
                segment = lowest(segments)
                segments = without_lowest(segments)
                at = slot * PIXELS + segment * LANES
                store_lanes(sums, at, plus(lanes_at(sums, at), blend(rays, splat, segment)))
        for slot in range(slots):
            slot_of[label_of[slot] + 1] = -1
        if full:
            return tile
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                best, winner = np.float32(0.0), np.int32(-1)
                for slot in range(slots):
                    total = sums[slot * PIXELS + place_of(y, x)]
                    if total > best or (total == best and total > 0 and label_of[slot] < winner):
                        best, winner = total, label_of[slot]
                image[y0 + y, x0 + x] = winner
        for at in range(slots * PIXELS):
            sums[at] = 0
    return last


def trace_rays(frame: Frame, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows of A for single pixels [n, 2] i32 (x, y), bitwise identical to the A of the render.

    Returns:
        indptr [n + 1] i64, splats [nnz] i32 near to far, weights [nnz] f32.
    """
    indptr, size = np.zeros(len(pixels) + 1, np.int64), 1 << 12
    splats, weights = np.empty(size, np.int32), np.empty(size, np.float32)
    rays, first = new_rays(frame), 0
    while True:
        first, required = _trace(first, frame, rays, pixels, indptr, splats, weights)
        if first == len(pixels):
            return indptr, splats[: indptr[-1]], weights[: indptr[-1]]
        growth = max(len(splats), required)
        splats = np.concatenate((splats, np.empty(growth, np.int32)))
        weights = np.concatenate((weights, np.empty(growth, np.float32)))


@kernel
def _trace(first, frame, rays, pixels, indptr, splats, weights):
    """Composite one ray at a time through its tile, whose other rays are terminated."""
    state, lane_weights, count = rays.state, np.zeros(LANES, np.float32), indptr[first]
    for i in range(first, pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        tile = (y // TILE) * frame.columns + x // TILE
        required = frame.starts[tile + 1] - frame.starts[tile]
        if count + required > splats.shape[0]:
            return i, required
        ray = place_of(y % TILE, x % TILE)
        segment, lane = ray // LANES, ray % LANES
        store_lanes(state, TRANSMITTANCE + segment * LANES, no_lanes())
        state[TRANSMITTANCE + ray] = 1.0
        rays.active[0] = np.uint64(1) << np.uint64(segment)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            splat = next_splat(frame, tile, step, float(x - x % TILE), float(y - y % TILE))
            if not meets(rays, splat):
                continue
            store_lanes(lane_weights, 0, blend(rays, splat, segment))
            if lane_weights[lane] > 0:
                splats[count], weights[count] = frame.ids[frame.items[step]], lane_weights[lane]
                count += 1
            elif state[TRANSMITTANCE + ray] == 0:
                break
        indptr[i + 1] = count
    return pixels.shape[0], 0
