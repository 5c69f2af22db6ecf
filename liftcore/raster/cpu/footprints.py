"""One contract for the footprints of all kernels: what a tile's walk asks of a splat.

``footprint(kernel, records, place, x0, y0)`` is a record as a tile sees it; ``halves_of(splat, state)`` the half rows
of eight pixels that it can reach; ``lanes_of(splat, state, half)``, for one of these, what ``lanes_blend``
makes weights of; ``alpha_at`` the alpha at one point.
``circle_of`` is what a record can reach beside its outline, for the tiles.

numba compiles each for the class of its first argument, so a product is compiled once for each kernel that is used
and pays nothing for the others. Everything that a kernel adds to the walk stands here: a class of its own for the
view's constants and one for its footprint, and the five functions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba.extending import overload

from liftcore.jit import inlined
from liftcore.raster.constants import ALPHA_FLOOR, LARGEST_EXPONENT
from liftcore.raster.cpu.lanes import BASES, LANES, ROWS, STARTS
from liftcore.raster.cpu.lanes_blend import BetaLanes, DiscLanes, GaussianLanes
from liftcore.raster.cpu.lanes_halves import either, ellipse_halves
from liftcore.raster.cpu.records import (
    BETA,
    CENTRE_X,
    CENTRE_Y,
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
    REACH,
    ROOT_X,
    S_X,
    S_Y,
    SLOPE,
    T_X,
    T_Y,
)

if TYPE_CHECKING:
    from collections.abc import Callable

_SPLITTER = 2.0**32 + 1.0  # leaves 21 of a float64's 53 bits: three fewer than a float32 has, for lanes 0 .. 7


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

    mx: float
    my: float
    slope: float
    root_x: float
    ky: float
    reach: float
    opacity: float
    plain: float  # opacity without the gain
    fade: float  # -log2 of the opacity


class BetaFootprint(NamedTuple):
    """The same, with the exponent of its falloff."""

    mx: float
    my: float
    slope: float
    root_x: float
    ky: float
    reach: float
    opacity: float
    plain: float
    fade: float
    beta: float


class DiscFootprint(NamedTuple):
    """A disc: an outline that holds all its crossings, and a small circle for the low-pass."""

    mx: float  # the projected centre
    my: float
    outline_x: float  # centre of the outline
    outline_y: float
    slope: float
    root_x: float
    ky: float
    reach: float
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


def footprint(kernel, records, place, x0, y0) -> Any:
    """The record of a splat for the tile whose first pixel is (x0, y0)."""


def halves_of(splat, state) -> Any:
    """The half rows of the tile that can have a weight, as ``liftcore.raster.cpu.lanes_halves`` has sets of them.

    What ``lanes_of`` needs of each is left in the tile's state.
    """


def lanes_of(splat, state, half) -> Any:
    """The footprint on a half row of ``halves_of``, for ``lanes_blend``."""


def alpha_at(kernel, record, x, y) -> Any:
    """Alpha at one point of the image, before cap and floor, f64."""


def circle_of(kernel, record) -> Any:
    """Centre x, y and radius, px, of a circle that the splat reaches beside its outline; a radius below 0 is none."""


def _gaussian_footprint(kernel, records, place, x0, y0):
    return GaussianFootprint(
        records[place, MX] - x0 - 0.5,
        records[place, MY] - y0 - 0.5,
        records[place, SLOPE],
        records[place, ROOT_X],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
        records[place, FADE],
    )


def _beta_footprint(kernel, records, place, x0, y0):
    return BetaFootprint(
        records[place, MX] - x0 - 0.5,
        records[place, MY] - y0 - 0.5,
        records[place, SLOPE],
        records[place, ROOT_X],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
        records[place, FADE],
        records[place, BETA],
    )


def _disc_footprint(kernel, records, place, x0, y0):
    return DiscFootprint(
        records[place, CENTRE_X] - x0 - 0.5,
        records[place, CENTRE_Y] - y0 - 0.5,
        records[place, MX] - x0 - 0.5,
        records[place, MY] - y0 - 0.5,
        records[place, SLOPE],
        records[place, ROOT_X],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
        records[place, FADE],
        records[place, NEARBY],
        math.sqrt(kernel.curvature),
        records[place, S_X],
        records[place, S_Y],
        records[place, T_X],
        records[place, T_Y],
        records[place, D_ZERO],
        records[place, D_X],
        records[place, D_Y],
    )


def _ellipse_halves(splat, state):
    return ellipse_halves(state, (splat.mx, splat.my), splat.slope, (splat.root_x, splat.ky), splat.reach)


def _disc_halves(splat, state):
    outline = (splat.outline_x, splat.outline_y), splat.slope, (splat.root_x, splat.ky)
    within = ellipse_halves(state, *outline, splat.reach)
    squared = splat.nearby * splat.nearby if splat.nearby >= 0 else -1.0
    return either(within, ellipse_halves(state, (splat.mx, splat.my), 0.0, (1.0, 1.0), squared))


def _gaussian_lanes(splat, state, half):
    return GaussianLanes(state[STARTS + half], np.float32(splat.root_x), state[BASES + (half & (ROWS - 1))])


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


def _beta_lanes(splat, state, half):
    dx, dy = half // ROWS * LANES - splat.mx, half % ROWS - splat.my
    start, start_rest = _halved(splat.root_x * (dx - splat.slope * dy))
    root, root_rest = _coarsened(splat.root_x)
    return BetaLanes(start, start_rest, root, root_rest, np.float32(splat.ky * dy * dy), np.float32(splat.beta))


def _disc_lanes(splat, state, half):
    dx, dy = half // ROWS * LANES - splat.mx, half % ROWS - splat.my
    s, s_rest = _halved(splat.s_x * dx + splat.s_y * dy)
    s_step, s_step_rest = _coarsened(splat.s_x)
    t, t_rest = _halved(splat.t_x * dx + splat.t_y * dy)
    t_step, t_step_rest = _coarsened(splat.t_x)
    d, d_rest = _halved(splat.d_zero + splat.d_x * dx + splat.d_y * dy)
    d_step, d_step_rest = _coarsened(splat.d_x)
    return DiscLanes(
        np.float32(splat.near_root * dx), np.float32(splat.near_root), np.float32((splat.near_root * dy) ** 2),
        s, s_rest, s_step, s_step_rest, t, t_rest, t_step, t_step_rest, d, d_rest, d_step, d_step_rest,
    )  # fmt: skip


@inlined
def _ellipse_at(record, x, y):
    """The quadratic form of a record at a point."""
    dy = y - record[MY]
    across = record[ROOT_X] * (x - record[MX] - record[SLOPE] * dy)
    return across * across + record[KY] * dy * dy


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
    "halves_of": {GaussianFootprint: _ellipse_halves, BetaFootprint: _ellipse_halves, DiscFootprint: _disc_halves},
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


@overload(halves_of, inline="always")
def _overload_halves_of(splat, state):
    return _chosen("halves_of", splat)


@overload(lanes_of, inline="always")
def _overload_lanes_of(splat, state, half):
    return _chosen("lanes_of", splat)


@overload(alpha_at, inline="always")
def _overload_alpha_at(kernel, record, x, y):
    return _chosen("alpha_at", kernel)


@overload(circle_of, inline="always")
def _overload_circle_of(kernel, record):
    return _chosen("circle_of", kernel)


GAUSSIANS = Gaussians(ALPHA_FLOOR)
BETAS = Betas(0.0)
