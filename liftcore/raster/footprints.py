"""One contract for the footprints of all kernels: what a tile's walk asks of a splat.

``footprint(kernel, records, place, x0, y0)`` is a record as a tile sees it; ``row_of(splat, row)`` what the tile's
pixel rows share of it; ``touches(splat, line, side)`` whether it can reach a half row of eight pixels;
``lanes_of(splat, line, side)`` what ``liftcore.lanes_blend`` makes weights of; ``alpha_at`` the alpha at one point.
``circle_of`` is what a record can reach beside its outline, for the tiles.

numba compiles each for the class of its first argument, so a product is compiled once for each kernel that is used
and pays nothing for the others. Everything that a kernel adds to the walk stands here: a class of its own for the
view's constants, for its footprint and for its rows, and the six functions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba.extending import overload

from liftcore.jit import inlined
from liftcore.lanes import LANES
from liftcore.lanes_blend import BetaLanes, DiscLanes, GaussianLanes
from liftcore.raster.constants import ALPHA_FLOOR, LARGEST_EXPONENT, TILE
from liftcore.raster.records import (
    BETA,
    CENTRE_X,
    CENTRE_Y,
    D_X,
    D_Y,
    D_ZERO,
    EXTENT_Y,
    KX,
    KY,
    MX,
    MY,
    NEARBY,
    OPACITY,
    PLAIN,
    REACH,
    S_X,
    S_Y,
    SLOPE,
    T_X,
    T_Y,
)

if TYPE_CHECKING:
    from collections.abc import Callable


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


class GaussianFootprint(NamedTuple):
    """One splat as a tile sees it: the record relative to the tile's first pixel centre."""

    top: int  # first pixel row of the tile that it can reach
    bottom: int  # last one; before the first when there is none
    mx: float
    my: float
    slope: float
    kx: float
    ky: float
    reach: float
    opacity: float
    plain: float  # opacity without the gain


class BetaFootprint(NamedTuple):
    """The same, with the exponent of its falloff."""

    top: int
    bottom: int
    mx: float
    my: float
    slope: float
    kx: float
    ky: float
    reach: float
    opacity: float
    plain: float
    beta: float


class DiscFootprint(NamedTuple):
    """A disc: an outline that holds all its crossings, and a small circle for the low-pass."""

    top: int
    bottom: int
    mx: float  # the projected centre
    my: float
    outline_x: float  # centre of the outline
    outline_y: float
    slope: float
    kx: float
    ky: float
    reach: float
    opacity: float
    plain: float
    nearby: float  # px, radius of the circle
    curvature: float  # of the low-pass
    s_x: float  # s, t and d by pixel, from the projected centre on
    s_y: float
    t_x: float
    t_y: float
    d_zero: float
    d_x: float
    d_y: float


class EllipseRow(NamedTuple):
    """A footprint in one pixel row: its centre in lanes, and e (or sigma) there."""

    centre: float
    base: float


class DiscRow(NamedTuple):
    """A disc in one pixel row."""

    centre: float  # of the outline, in lanes
    base: float  # of the outline
    low_pass: float  # e of the low-pass at the projected centre's column
    near_lanes: float  # lanes on each side of it that the circle reaches; negative for none
    s: float  # at lane 0
    t: float
    d: float


def footprint(kernel, records, place, x0, y0) -> Any:
    """The record of a splat for the tile whose first pixel is (x0, y0)."""


def row_of(splat, row) -> Any:
    """The footprint in one pixel row of the tile."""


def touches(splat, line, side) -> Any:
    """Whether any lane of half row ``side`` (0 left, 1 right) can have a weight."""


def lanes_of(splat, line, side) -> Any:
    """The footprint on half row ``side``, for ``liftcore.lanes_blend``."""


def alpha_at(kernel, record, x, y) -> Any:
    """Alpha at one point of the image, before cap and floor, f64."""


def circle_of(kernel, record) -> Any:
    """Centre x, y and radius, px, of a circle that the splat reaches beside its outline; a radius below 0 is none."""


@inlined
def _row_span(middle, extent):
    """First and last pixel row of the tile within ``extent`` of ``middle``."""
    return int(max(0.0, np.ceil(middle - extent))), int(min(TILE - 1.0, np.floor(middle + extent)))


def _gaussian_footprint(kernel, records, place, x0, y0):
    my = records[place, MY] - y0 - 0.5
    top, bottom = _row_span(my, records[place, EXTENT_Y])
    return GaussianFootprint(
        top,
        bottom,
        records[place, MX] - x0 - 0.5,
        my,
        records[place, SLOPE],
        records[place, KX],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
    )


def _beta_footprint(kernel, records, place, x0, y0):
    my = records[place, MY] - y0 - 0.5
    top, bottom = _row_span(my, records[place, EXTENT_Y])
    return BetaFootprint(
        top,
        bottom,
        records[place, MX] - x0 - 0.5,
        my,
        records[place, SLOPE],
        records[place, KX],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
        records[place, BETA],
    )


def _disc_footprint(kernel, records, place, x0, y0):
    outline_y = records[place, MY] - y0 - 0.5
    my = records[place, CENTRE_Y] - y0 - 0.5
    top, bottom = _row_span(outline_y, records[place, EXTENT_Y])
    near_top, near_bottom = _row_span(my, records[place, NEARBY])
    return DiscFootprint(
        min(top, near_top),
        max(bottom, near_bottom),
        records[place, CENTRE_X] - x0 - 0.5,
        my,
        records[place, MX] - x0 - 0.5,
        outline_y,
        records[place, SLOPE],
        records[place, KX],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
        records[place, NEARBY],
        kernel.curvature,
        records[place, S_X],
        records[place, S_Y],
        records[place, T_X],
        records[place, T_Y],
        records[place, D_ZERO],
        records[place, D_X],
        records[place, D_Y],
    )


def _ellipse_row(splat, row):
    dy = row - splat.my
    return EllipseRow(splat.mx + splat.slope * dy, splat.ky * dy * dy)


def _disc_row(splat, row):
    outline_dy = row - splat.outline_y
    dy = row - splat.my
    room = splat.nearby * splat.nearby - dy * dy
    return DiscRow(
        splat.outline_x + splat.slope * outline_dy,
        splat.ky * outline_dy * outline_dy,
        splat.curvature * dy * dy,
        math.sqrt(room) if room >= 0 else -1.0,
        splat.s_y * dy - splat.s_x * splat.mx,
        splat.t_y * dy - splat.t_x * splat.mx,
        splat.d_zero + splat.d_y * dy - splat.d_x * splat.mx,
    )


@inlined
def _distance(centre, side):
    """Lanes from ``centre`` to the nearest lane of a half row; zero inside."""
    return max(0.0, side * LANES - centre, centre - (side * LANES + LANES - 1))


def _ellipse_touches(splat, line, side):
    near = _distance(line.centre, side)
    return splat.kx * near * near + line.base <= splat.reach


def _disc_touches(splat, line, side):
    near = _distance(line.centre, side)
    return splat.kx * near * near + line.base <= splat.reach or _distance(splat.mx, side) <= line.near_lanes


def _gaussian_lanes(splat, line, side):
    return GaussianLanes(np.float32(side * LANES - line.centre), np.float32(splat.kx), np.float32(line.base))


def _beta_lanes(splat, line, side):
    return BetaLanes(
        np.float32(side * LANES - line.centre),
        np.float32(splat.kx),
        np.float32(line.base),
        np.float32(splat.beta),
    )


@inlined
def _halved(value):
    """A float64 as a float32 and the rest of it."""
    rounded = np.float32(value)
    return rounded, np.float32(value - rounded)


def _disc_lanes(splat, line, side):
    s, s_rest = _halved(line.s + splat.s_x * (side * LANES))
    s_step, s_step_rest = _halved(splat.s_x)
    t, t_rest = _halved(line.t + splat.t_x * (side * LANES))
    t_step, t_step_rest = _halved(splat.t_x)
    d, d_rest = _halved(line.d + splat.d_x * (side * LANES))
    d_step, d_step_rest = _halved(splat.d_x)
    start, curvature, base = side * LANES - splat.mx, splat.curvature, line.low_pass
    return DiscLanes(
        np.float32(start), np.float32(curvature), np.float32(base),
        s, s_rest, s_step, s_step_rest, t, t_rest, t_step, t_step_rest, d, d_rest, d_step, d_step_rest,
    )  # fmt: skip


@inlined
def _ellipse_at(record, x, y):
    """The quadratic form of a record at a point."""
    dy = y - record[MY]
    dx = x - record[MX] - record[SLOPE] * dy
    return record[KX] * dx * dx + record[KY] * dy * dy


def _gaussian_alpha(kernel, record, x, y):
    return record[OPACITY] * math.pow(2.0, -_ellipse_at(record, x, y))


def _beta_alpha(kernel, record, x, y):
    sigma = _ellipse_at(record, x, y)
    if sigma >= 1.0:
        return 0.0
    exponent = -record[BETA] * math.log1p(-sigma) / math.log(2.0)
    return record[OPACITY] * math.pow(2.0, -exponent) if exponent < LARGEST_EXPONENT else 0.0


def _disc_alpha(kernel, record, x, y):
    dx, dy = x - record[CENTRE_X], y - record[CENTRE_Y]
    exponent = kernel.curvature * (dx * dx + dy * dy)
    d = record[D_ZERO] + record[D_X] * dx + record[D_Y] * dy
    if d > 0.0:
        s = record[S_X] * dx + record[S_Y] * dy
        t = record[T_X] * dx + record[T_Y] * dy
        exponent = min(exponent, (s * s + t * t) / (d * d))
    return record[OPACITY] * math.pow(2.0, -exponent)


def _no_circle(kernel, record):
    return 0.0, 0.0, -1.0


def _disc_circle(kernel, record):
    return record[CENTRE_X], record[CENTRE_Y], record[NEARBY]


_BY_CLASS: dict[str, dict[type, Callable]] = {
    "footprint": {Gaussians: _gaussian_footprint, Betas: _beta_footprint, Discs: _disc_footprint},
    "row_of": {GaussianFootprint: _ellipse_row, BetaFootprint: _ellipse_row, DiscFootprint: _disc_row},
    "touches": {GaussianFootprint: _ellipse_touches, BetaFootprint: _ellipse_touches, DiscFootprint: _disc_touches},
    "lanes_of": {GaussianFootprint: _gaussian_lanes, BetaFootprint: _beta_lanes, DiscFootprint: _disc_lanes},
    "alpha_at": {Gaussians: _gaussian_alpha, Betas: _beta_alpha, Discs: _disc_alpha},
    "circle_of": {Gaussians: _no_circle, Betas: _no_circle, Discs: _disc_circle},
}


def _chosen(name: str, first: Any) -> Callable:
    """The plain Python function that numba compiles in place of ``name`` for the class of its first argument."""
    return _BY_CLASS[name][first.instance_class]


@overload(footprint, inline="always")
def _overload_footprint(kernel, records, place, x0, y0):
    return _chosen("footprint", kernel)


@overload(row_of, inline="always")
def _overload_row_of(splat, row):
    return _chosen("row_of", splat)


@overload(touches, inline="always")
def _overload_touches(splat, line, side):
    return _chosen("touches", splat)


@overload(lanes_of, inline="always")
def _overload_lanes_of(splat, line, side):
    return _chosen("lanes_of", splat)


@overload(alpha_at, inline="always")
def _overload_alpha_at(kernel, record, x, y):
    return _chosen("alpha_at", kernel)


@overload(circle_of, inline="always")
def _overload_circle_of(kernel, record):
    return _chosen("circle_of", kernel)


GAUSSIANS = Gaussians(ALPHA_FLOOR)
BETAS = Betas(0.0)
