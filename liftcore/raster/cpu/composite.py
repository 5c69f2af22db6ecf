"""Compositing: a tile's rays through its splats, front to back, and what images and rays are made of it.

A tile has 32 row segments of eight pixels. Every product takes the segments that a splat ``meets`` one by one, lets
it ``blend`` there and uses the weights at once, while they are in a register.

What a kernel adds to this stands in the first part: a class for the view's constants, one for a splat as a tile sees
it, and four functions. numba compiles each for the class of its first argument, so a product is compiled once for
each kernel that is used and pays nothing for the others.
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
    FADE,
    KY,
    MX,
    MY,
    NEARBY,
    OPACITY,
    PLAIN,
    ROOT_X,
    S_X,
    S_Y,
    SLOPE,
    T_X,
    T_Y,
    View,
    low_pass_curvature,
)
from liftcore.raster.cpu.simd import (
    BASES,
    LANES,
    PIXELS,
    PLAIN_TRANSMITTANCE,
    ROWS,
    SEGMENTS,
    STARTS,
    TRANSMITTANCE,
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
    keep_lanes,
    lanes_at,
    larger,
    lowest,
    new_state,
    no_lanes,
    only_lane,
    plus,
    plus_product,
    smaller,
    sum_of_lanes,
    times,
    where_above,
    where_equal,
    where_reached,
    without_lowest,
)
from liftcore.runtime.jit import inlined, kernel
from liftcore.scene.compositing import ALPHA_FLOOR, TILE, Selection, Weighting, check_weighting
from liftcore.scene.kernel import Kernel

if TYPE_CHECKING:
    from collections.abc import Callable

_AHEAD = 8  # items of a tile's list between asking for a splat and reading it: they lie anywhere in memory
CHECK_EVERY = 16  # splats between two looks at which segments are still active
_SPLITTER = 2.0**32 + 1.0  # leaves 21 of a float64's 53 bits: three fewer than a float32 has, for lanes 0 .. 7


# --------------------------------------------------------------------------------------------- A splat of each kernel


class Gaussians(NamedTuple):
    """3DGS: ``alpha = opacity 2^-e``."""

    floor: float  # a smaller alpha counts as none


class Betas(NamedTuple):
    """DBS: ``alpha = opacity (1 - sigma)^beta``; its support is compact, so no alpha is too small."""

    floor: float


class Discs(NamedTuple):
    """2DGS: ``alpha = opacity 2^-e``, e by the crossing of the ray and the disc's plane, or by the low-pass."""

    floor: float
    curvature: float  # of the low-pass: e = curvature |p - mu|^2, per px^2 of the view


class TileGaussian(NamedTuple):
    """A projected splat relative to the tile's first pixel centre."""

    mx: float
    my: float
    slope: float
    root_x: float
    ky: float
    cutoff: float
    opacity: float
    plain: float  # opacity whose logit is not scaled
    fade: float  # -log2 of the opacity


class TileBeta(NamedTuple):
    """The same, with the exponent of its falloff."""

    mx: float
    my: float
    slope: float
    root_x: float
    ky: float
    cutoff: float
    opacity: float
    plain: float
    fade: float
    beta: float


class TileDisc(NamedTuple):
    """A disc: an outline that holds all its crossings, and a small circle for the low-pass."""

    mx: float  # the projected centre
    my: float
    outline_x: float  # centre of the outline
    outline_y: float
    slope: float
    root_x: float
    ky: float
    cutoff: float
    opacity: float
    plain: float
    fade: float
    nearby: float  # px, radius of the circle
    near_root: float  # of the low-pass's curvature
    s_x: float  # s, t and d by pixel, from the projected centre on
    s_y: float
    t_x: float
    t_y: float
    d_zero: float
    d_x: float
    d_y: float


def kernel_in(view: View, kind: Kernel) -> Gaussians | Betas | Discs:
    """The kernel's constants in a view; their class tells the compiled code which kernel it is."""
    if kind is Kernel.GAUSSIAN_2D:
        return Discs(ALPHA_FLOOR, low_pass_curvature(view))
    return Betas(0.0) if kind is Kernel.BETA else Gaussians(ALPHA_FLOOR)


def tile_splat(kernel, projected, row, x0, y0) -> Any:
    """A projected splat for the tile whose first pixel is (x0, y0)."""


def segments_of(splat, state) -> Any:
    """The set of the tile's segments that can have a weight; what ``shape_of`` needs is left in the tile's state."""


def shape_of(splat, state, segment) -> Any:
    """The splat on a segment of ``segments_of``, as ``simd`` blends it."""


def circle_of(kernel, own) -> Any:
    """Centre x, y and radius, px, of a circle that the splat reaches beside its outline; a radius below 0 is none."""


def _tile_gaussian(kernel, projected, row, x0, y0):
    own = projected[row]
    return TileGaussian(
        own[MX] - x0 - 0.5, own[MY] - y0 - 0.5, own[SLOPE], own[ROOT_X], own[KY], own[CUTOFF],
        own[OPACITY], own[PLAIN], own[FADE],
    )  # fmt: skip


def _tile_beta(kernel, projected, row, x0, y0):
    own = projected[row]
    return TileBeta(
        own[MX] - x0 - 0.5, own[MY] - y0 - 0.5, own[SLOPE], own[ROOT_X], own[KY], own[CUTOFF],
        own[OPACITY], own[PLAIN], own[FADE], own[BETA],
    )  # fmt: skip


def _tile_disc(kernel, projected, row, x0, y0):
    own = projected[row]
    return TileDisc(
        own[CENTRE_X] - x0 - 0.5, own[CENTRE_Y] - y0 - 0.5, own[MX] - x0 - 0.5, own[MY] - y0 - 0.5,
        own[SLOPE], own[ROOT_X], own[KY], own[CUTOFF], own[OPACITY], own[PLAIN], own[FADE],
        own[NEARBY], math.sqrt(kernel.curvature),
        own[S_X], own[S_Y], own[T_X], own[T_Y], own[D_ZERO], own[D_X], own[D_Y],
    )  # fmt: skip


def _ellipse_segments(splat, state):
    return ellipse_segments(state, (splat.mx, splat.my), splat.slope, (splat.root_x, splat.ky), splat.cutoff)


def _disc_segments(splat, state):
    outline = (splat.outline_x, splat.outline_y), splat.slope, (splat.root_x, splat.ky)
    within = ellipse_segments(state, *outline, splat.cutoff)
    squared = splat.nearby * splat.nearby if splat.nearby >= 0 else -1.0
    return within | ellipse_segments(state, (splat.mx, splat.my), 0.0, (1.0, 1.0), squared)


def _gaussian_shape(splat, state, segment):
    return GaussianSegment(state[STARTS + segment], np.float32(splat.root_x), state[BASES + (segment & (ROWS - 1))])


@inlined
def _halved(value):
    """A float64 as a float32 and the rest of it."""
    rounded = np.float32(value)
    return rounded, np.float32(value - rounded)


@inlined
def _coarsened(value):
    """A float64 as a float32 of 21 bits, whose product with a lane is exact, and the rest (Veltkamp's split)."""
    large = _SPLITTER * value
    coarse = np.float32(large - (large - value))
    return coarse, np.float32(value - coarse)


def _beta_shape(splat, state, segment):
    dx, dy = segment // ROWS * LANES - splat.mx, segment % ROWS - splat.my
    start, start_rest = _halved(splat.root_x * (dx - splat.slope * dy))
    root, root_rest = _coarsened(splat.root_x)
    return BetaSegment(start, start_rest, root, root_rest, np.float32(splat.ky * dy * dy), np.float32(splat.beta))


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


def _no_circle(kernel, own):
    return 0.0, 0.0, -1.0


def _disc_circle(kernel, own):
    return own[CENTRE_X], own[CENTRE_Y], own[NEARBY]


_BY_CLASS: dict[Callable, dict[type, Callable]] = {
    tile_splat: {Gaussians: _tile_gaussian, Betas: _tile_beta, Discs: _tile_disc},
    segments_of: {TileGaussian: _ellipse_segments, TileBeta: _ellipse_segments, TileDisc: _disc_segments},
    shape_of: {TileGaussian: _gaussian_shape, TileBeta: _beta_shape, TileDisc: _disc_shape},
    circle_of: {Gaussians: _no_circle, Betas: _no_circle, Discs: _disc_circle},
}


def _compile_by_class(function: Callable) -> None:
    """Have numba compile, in place of the function, the plain Python one for the class of its first argument."""

    def chosen(first, *others):
        return _BY_CLASS[function][first.instance_class]

    overload(function, inline="always", strict=False)(chosen)


for _function in _BY_CLASS:
    _compile_by_class(_function)


# -------------------------------------------------------------------------------------------------- A tile's 256 rays


class Frame(NamedTuple):
    """One view, projected and binned."""

    kernel: Gaussians | Betas | Discs  # its class chooses the kernel's functions, at compile time
    projected: np.ndarray  # [P, COLUMNS] f64, projected splats; rows in use are named by ids
    ids: np.ndarray  # [P] i32, the splat of a row
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

    state: np.ndarray  # [STATE] f32, laid out as liftcore.raster.cpu.simd says
    active: np.ndarray  # [1] u64, the segments with a ray that is not done, with its logits scaled or plain


def new_rays(frame: Frame) -> Rays:
    """Room for one tile's rays."""
    state = new_state(frame.kernel.floor, frame.alpha_cap, frame.transmittance_stop)
    return Rays(state, np.zeros(1, np.uint64))


@inlined
def place_of(y, x):
    """Where the ray of a tile's pixel lies among its 256."""
    return (x // LANES * ROWS + y) * LANES + x % LANES


@inlined
def next_splat(frame, tile, step, x0, y0):
    """The splat of an item of a tile's list; one that comes soon is asked for."""
    if step + _AHEAD < frame.starts[tile + 1]:
        fetch_row(frame.projected, frame.items[step + _AHEAD])
    return tile_splat(frame.kernel, frame.projected, frame.items[step], x0, y0)


@kernel
def start_rays(state, x0, y0, width, height):
    """Full transmittance for every ray of a tile that lies inside the image."""
    for y in range(TILE):
        for x in range(TILE):
            inside = np.float32(x0 + x < width and y0 + y < height)
            state[TRANSMITTANCE + place_of(y, x)] = inside
            state[PLAIN_TRANSMITTANCE + place_of(y, x)] = inside


@inlined
def look(rays, with_plain):
    """Note which segments are still active; whether any is."""
    active = active_segments(rays.state, TRANSMITTANCE)
    if with_plain:
        active |= active_segments(rays.state, PLAIN_TRANSMITTANCE)
    rays.active[0] = active
    return active != 0


@inlined
def meets(rays, splat):
    """The active segments where the splat can have a weight."""
    return segments_of(splat, rays.state) & rays.active[0]


@inlined
def blend(rays, splat, segment):
    """Composite the splat over a segment: its weights, eight lanes."""
    return blend_lanes(rays.state, segment * LANES, shape_of(splat, rays.state, segment), np.float32(splat.fade))


@inlined
def blend_both(rays, splat, segment, plain):
    """``blend``, and the weights of plain logits: on rays of their own, or the same where ``plain`` is None.

    The two ways differ in the last digits, so who compares weights for equality has to go one way.
    """
    if plain is None:
        scaled = blend(rays, splat, segment)
        return scaled, scaled
    shape = shape_of(splat, rays.state, segment)
    return blend_twice(rays.state, segment * LANES, shape, (np.float32(splat.opacity), np.float32(splat.plain)))


# ------------------------------------------------------------------------- Which of a ray's weights count, and how
# much
#
# Where all weights count at power 1 or 2, nobody comes here. For the others, ``selected`` zeroes the lanes that do
# not count. The k largest weights of a ray are known only at its end, so top-k composites every tile twice:
# ``rank_tile`` finds what the least of them is, ``selected`` then keeps to it.

EVERY, LARGEST, FRONT, CENTRAL = range(4)
_KINDS = {
    Selection.ALL: EVERY,
    Selection.TOP_K: LARGEST,
    Selection.FRONT_MASS: FRONT,
    Selection.CENTRE: CENTRAL,
}
NO_SPOT = -1  # the splat's centre lies in another tile


class Choice(NamedTuple):
    """A Weighting as the compiled code takes it."""

    gated: bool  # whether any weight may be left out or counted otherwise than blending leaves it
    kind: int
    power: int
    k: int  # of top-k
    transmittance: np.float32  # of front-mass: a weight counts while T before it is above this
    floor: np.float32


def choice_of(weighting: Weighting) -> Choice:
    """The weighting for the compiled code; InvalidInput where it is out of its range."""
    check_weighting(weighting)
    kind = _KINDS[weighting.selection]
    gated = kind != EVERY or weighting.power == 0 or weighting.floor > 0
    behind = np.float32(1.0 - weighting.mass)
    return Choice(gated, kind, weighting.power, weighting.count, behind, np.float32(weighting.floor))


def new_marks(choice: Choice | None) -> np.ndarray | None:
    """What top-k knows of a tile's 256 rays after its first pass: [(k + 1) * 256] f32, of no use to other choices.

    The rays' largest weights, then their second largest, and so on to the k-th, 0 for none; at last how many weights
    equal to a ray's k-th belong to the k. None where all weights count (None).
    """
    return None if choice is None else np.zeros((choice.k + 1) * PIXELS, np.float32)


@kernel
def rank_tile(rays, frame, tile, marks, plain):
    """Composite a tile, as ``weigh_tiles`` will, for the largest weights of its rays; the rays are spent."""
    x0 = float((tile % frame.columns) * TILE)
    y0 = float((tile // frame.columns) * TILE)
    start_rays(rays.state, int(x0), int(y0), frame.width, frame.height)
    met = np.zeros(SEGMENTS, np.int64)  # splats of each segment: it has no more weights than that
    for place in range(marks.shape[0]):
        marks[place] = 0
    last = marks.shape[0] // PIXELS - 2
    for step in range(frame.starts[tile], frame.starts[tile + 1]):
        if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
            break
        splat = next_splat(frame, tile, step, x0, y0)
        segments = meets(rays, splat)
        while segments:
            segment = lowest(segments)
            segments = without_lowest(segments)
            weights = blend_both(rays, splat, segment, plain)[0]
            at = min(met[segment], last) * PIXELS + segment * LANES
            met[segment] += 1
            while at >= PIXELS and any_above(weights, lanes_at(marks, at)):
                above = lanes_at(marks, at - PIXELS)
                keep_lanes(marks, at, larger(lanes_at(marks, at), smaller(above, weights)))
                at -= PIXELS
            if at < PIXELS:
                keep_lanes(marks, at, larger(lanes_at(marks, at), weights))
    least = last * PIXELS
    for place in range(least + PIXELS):
        ray = place % PIXELS
        marks[least + PIXELS + ray] += np.float32(marks[place] == marks[least + ray])


@inlined
def spot_of(splat):
    """The ray of the tile at the splat's projected centre; NO_SPOT when there is none."""
    column, row = math.floor(splat.mx + 0.5), math.floor(splat.my + 0.5)
    if 0 <= column < TILE and 0 <= row < TILE:
        return place_of(int(row), int(column))
    return NO_SPOT


@inlined
def selected(choice, weights, behind, marks, lane):
    """A segment's weights as they count: zero in the lanes that do not, raised to the power in the others.

    Args:
        weights: eight lanes. behind: the transmittance behind them. marks: (the k-th weights of their rays; how many
            equal to those still belong to the k). lane: that of the splat's centre, if it is one of the eight.

    Returns:
        The weights, and the second of the marks.
    """
    none, (least, room) = no_lanes(), marks
    weights = where_reached(weights, in_all_lanes(choice.floor), weights)
    if choice.kind == CENTRAL:
        weights = only_lane(weights, lane)
    elif choice.kind == FRONT:
        weights = where_above(plus(behind, weights), in_all_lanes(choice.transmittance), weights)
    elif choice.kind == LARGEST:
        equal = where_equal(weights, least, where_above(room, none, weights))  # near to far, until k are full
        room = plus(room, where_above(equal, none, in_all_lanes(np.float32(-1.0))))
        weights = plus(where_above(weights, least, weights), equal)
    if choice.power == 0:
        weights = where_above(weights, none, in_all_lanes(np.float32(1.0)))
    elif choice.power == 2:
        weights = times(weights, weights)
    return weights, room


# ------------------------------------------------------------------------------------------------- Images and rays
#
# Compiled functions that cannot know how much room they need return where they came to, and go on there with more.


def render_tiles(first: int, last: int, frame: Frame, values: np.ndarray, image: np.ndarray) -> None:
    """``A X``: composite ``values`` [P, C] f32 over tiles ``first..last`` into ``image`` [H, W, C] f32."""
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
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
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
                    keep_lanes(sums, at, plus_product(lanes_at(sums, at), weights, value))
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                for channel in range(channels):
                    image[y0 + y, x0 + x, channel] = sums[channel * PIXELS + place_of(y, x)]
        for at in range(sums.shape[0]):
            sums[at] = 0


def gather_tiles(first: int, last: int, frame: Frame, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``A^T Y`` of tiles ``first..last`` for ``image`` [H, W, C] f32: the transpose of the render.

    A share of the tiles keeps one row of sums for each splat that it met: inside a tile eight lanes a channel, then
    one number, added tile by tile. ``add_sums`` adds the shares' rows in their order, so no sum depends on the
    threads.

    Returns:
        rows [n] i32 of projected splats, in the order of their first tile; sums [n, C] f32.
    """
    channels, size = image.shape[2], 1 << 10
    rays, found = new_rays(frame), np.full(len(frame.ids), -1, np.int32)
    pixels, lanes = np.zeros(channels * PIXELS, np.float32), np.zeros(channels * LANES, np.float32)
    rows, sums = np.empty(size, np.int32), np.zeros((size, channels), np.float32)
    tile, count = first, 0
    while True:
        tile, count = _gather(tile, last, frame, rays, image, pixels, lanes, found, rows, sums, count)
        if tile == last:
            return rows[:count], sums[:count]
        more = max(len(rows), int(frame.starts[tile + 1] - frame.starts[tile]))
        rows = np.concatenate((rows, np.empty(more, np.int32)))
        sums = np.concatenate((sums, np.zeros((more, channels), np.float32)))


@kernel
def _gather(first, last, frame, rays, image, pixels, lanes, found, rows, sums, count):
    channels = image.shape[2]
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        if count + frame.starts[tile + 1] - frame.starts[tile] > rows.shape[0]:
            return tile, count
        x0 = (tile % frame.columns) * TILE
        y0 = (tile // frame.columns) * TILE
        start_rays(rays.state, x0, y0, frame.width, frame.height)
        for y in range(min(TILE, frame.height - y0)):
            for x in range(min(TILE, frame.width - x0)):
                for channel in range(channels):
                    pixels[channel * PIXELS + place_of(y, x)] = image[y0 + y, x0 + x, channel]
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
                break
            splat = next_splat(frame, tile, step, float(x0), float(y0))
            segments = meets(rays, splat)
            if not segments:
                continue
            while segments:
                segment = lowest(segments)
                segments = without_lowest(segments)
                weights = blend(rays, splat, segment)
                for channel in range(channels):
                    own = lanes_at(pixels, channel * PIXELS + segment * LANES)
                    total = lanes_at(lanes, channel * LANES)
                    keep_lanes(lanes, channel * LANES, plus_product(total, weights, own))
            place = frame.items[step]
            if found[place] < 0:
                found[place], rows[count] = count, place
                count += 1
            for channel in range(channels):
                sums[found[place], channel] += sum_of_lanes(lanes_at(lanes, channel * LANES))
                keep_lanes(lanes, channel * LANES, no_lanes())
    return last, count


@kernel
def add_sums(first, last, rows, sums, ids, result, begin):
    """Add a share's sums whose rows lie in ``first..last`` to ``result`` [P, F] f32, from channel ``begin`` on."""
    for i in range(rows.shape[0]):
        if first <= rows[i] < last:
            splat = ids[rows[i]]
            for channel in range(sums.shape[1]):
                result[splat, begin + channel] += sums[i, channel]


def strongest_tiles(first: int, last: int, frame: Frame, labels: np.ndarray, count: int, image: np.ndarray) -> None:
    """``argmax(A onehot(labels))`` of tiles ``first..last``; equal sums go to the smallest label.

    A splat adds to one column of the one-hot render only, so a tile keeps sums for the labels that occur in it, and
    the cost does not depend on how many labels there are (paper, Post Aggregation Filtering).

    Args:
        labels: [P] i32 in -1..count - 1; -1 is a label like the others. image: [H, W] i32, filled with -1 before.
    """
    rays, slots = new_rays(frame), 32  # labels of a tile that there is room for at first
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
            if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
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
                keep_lanes(sums, at, plus(lanes_at(sums, at), blend(rays, splat, segment)))
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
    """Rows of A for single pixels [n, 2] i32 (x, y), to the bit those of the A that the render knows.

    Returns:
        indptr [n + 1] i64, splats [nnz] i32 near to far, weights [nnz] f32.
    """
    indptr, size = np.zeros(len(pixels) + 1, np.int64), 1 << 12
    splats, weights = np.empty(size, np.int32), np.empty(size, np.float32)
    rays, done = new_rays(frame), 0
    while True:
        done, needed = _trace(done, frame, rays, pixels, indptr, splats, weights)
        if done == len(pixels):
            return indptr, splats[: indptr[-1]], weights[: indptr[-1]]
        more = max(len(splats), needed)
        splats = np.concatenate((splats, np.empty(more, np.int32)))
        weights = np.concatenate((weights, np.empty(more, np.float32)))


@kernel
def _trace(first, frame, rays, pixels, indptr, splats, weights):
    """One ray at a time through its tile, whose other rays are done."""
    state, own, count = rays.state, np.zeros(LANES, np.float32), indptr[first]
    for i in range(first, pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        tile = (y // TILE) * frame.columns + x // TILE
        needed = frame.starts[tile + 1] - frame.starts[tile]
        if count + needed > splats.shape[0]:
            return i, needed
        ray = place_of(y % TILE, x % TILE)
        segment, lane = ray // LANES, ray % LANES
        keep_lanes(state, TRANSMITTANCE + segment * LANES, no_lanes())
        state[TRANSMITTANCE + ray] = 1.0
        rays.active[0] = np.uint64(1) << np.uint64(segment)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            splat = next_splat(frame, tile, step, float(x - x % TILE), float(y - y % TILE))
            if not meets(rays, splat):
                continue
            keep_lanes(own, 0, blend(rays, splat, segment))
            if own[lane] > 0:
                splats[count], weights[count] = frame.ids[frame.items[step]], own[lane]
                count += 1
            elif state[TRANSMITTANCE + ray] == 0:
                break
        indptr[i + 1] = count
    return pixels.shape[0], 0


def joined_rows(rows: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Rows of the same rays, of which each has its entries in one of the bands, as one (indptr, splats, weights)."""
    if len(rows) == 1:
        return rows[0]
    lengths = np.array([np.diff(indptr) for indptr, _, _ in rows])
    rays = np.concatenate([np.repeat(np.arange(lengths.shape[1]), own) for own in lengths])
    order = np.argsort(rays, kind="stable")
    splats, weights = (np.concatenate([row[k] for row in rows])[order] for k in (1, 2))
    return np.concatenate([[0], np.cumsum(lengths.sum(axis=0))]), splats, weights
