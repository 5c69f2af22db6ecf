"""Surfaces that a still life is built from, sampled evenly by area.

Frames: the world's z axis points up; lengths are in decimetres, as the objects of a table are a few of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator

_STEP = 1e-4  # of the parameters, for tangents by central differences
_OVERSAMPLING = 8  # candidates a sample when sampling by area


@dataclass(frozen=True)
class Samples:
    """Points on a surface with the frame of its tangents."""

    points: np.ndarray  # [n, 3] f64, world
    tangents: np.ndarray  # [n, 3] f64, unit, along u
    bitangents: np.ndarray  # [n, 3] f64, unit, across u on the surface
    normals: np.ndarray  # [n, 3] f64, unit, outwards where u x v points out
    parameters: np.ndarray  # [n, 2] f64, (u, v) in 0..1, for patterns


def sample(surface: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, rng: Generator) -> Samples:
    """Points spread evenly by area over a parametric surface.

    Args:
        surface: (u [n], v [n]) in 0..1 -> points [n, 3].
        count: n.
        rng: the generator of the scene.
    """
    u, v = _spread(surface, count, rng)
    along, across = _slopes(surface, u, v)
    normals = _unit(np.cross(along, across))
    tangents = _unit(along)
    return Samples(surface(u, v), tangents, np.cross(normals, tangents), normals, np.stack([u, v], axis=1))


def _spread(surface: Callable, count: int, rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """Parameters whose density follows the area, drawn by stratified quantiles so that gaps are few."""
    candidates = rng.random((_OVERSAMPLING * count, 2))
    along, across = _slopes(surface, *candidates.T)
    area = np.linalg.norm(np.cross(along, across), axis=1)
    # Candidates in order along the surface, so that equal steps of cumulative area spread over all of it.
    cells = max(1, int(np.sqrt(count)))
    row = np.minimum((candidates[:, 0] * cells).astype(int), cells - 1)
    order = np.lexsort((np.where(row % 2 == 0, candidates[:, 1], -candidates[:, 1]), row))
    total = np.cumsum(area[order])
    marks = (np.arange(count) + rng.random(count)) / count * total[-1]
    rows = order[np.minimum(np.searchsorted(total, marks), len(order) - 1)]
    return candidates[rows, 0], candidates[rows, 1]


def _slopes(surface: Callable, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    h = _STEP
    return surface(u + h, v) - surface(u - h, v), surface(u, v + h) - surface(u, v - h)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def rectangle(corner: tuple, side_u: tuple, side_v: tuple) -> Callable:
    """A flat rectangle from a corner along two sides."""
    origin, a, b = np.array(corner, float), np.array(side_u, float), np.array(side_v, float)
    return lambda u, v: origin + u[:, None] * a + v[:, None] * b


def disc(centre: tuple, radius: float) -> Callable:
    """A flat disc facing up."""
    origin = np.array(centre, float)

    def points(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        r, angle = radius * np.sqrt(np.abs(u)), 2 * np.pi * v
        return origin + np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(r)], axis=1)

    return points


def ellipsoid(centre: tuple, radii: tuple) -> Callable:
    """A closed ellipsoid with its poles on the z axis."""
    origin, scale = np.array(centre, float), np.array(radii, float)

    def points(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        angle, height = 2 * np.pi * u, np.pi * (v - 0.5)
        ring = np.cos(height)
        return origin + scale * np.stack([ring * np.cos(angle), ring * np.sin(angle), np.sin(height)], axis=1)

    return points


def lathe(centre: tuple, radii: tuple[float, ...], heights: tuple[float, ...]) -> Callable:
    """A profile of (radius, height) knots turned round the z axis; outwards when the heights rise."""
    origin = np.array(centre, float)
    knots = np.linspace(0.0, 1.0, len(radii))

    def points(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * u
        r, z = np.interp(v, knots, radii), np.interp(v, knots, heights)
        return origin + np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)

    return points


def tube(path: Callable, radius: Callable, plane_normal: tuple) -> Callable:
    """A tube along a path that lies in one plane. ``path``: [n] in 0..1 -> [n, 3]; ``radius``: [n] -> [n]."""
    # The path's plane has one normal: it never vanishes along the way, unlike the curvature.
    side = _unit(np.array([plane_normal], float))

    def points(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        step = _unit(path(v + _STEP) - path(v - _STEP))
        other = np.cross(step, side)
        angle = 2 * np.pi * u[:, None]
        return path(v) + radius(v)[:, None] * (np.cos(angle) * other - np.sin(angle) * side)

    return points


def leaf(root: tuple, reach: tuple, width: float, droop: float) -> Callable:
    """A blade that rises from a root along ``reach`` and bends down by ``droop`` at its tip."""
    origin, along = np.array(root, float), np.array(reach, float)
    across = _unit(np.cross(along, [[0.0, 0.0, 1.0]]))[0]

    def points(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        half = width * np.sin(np.pi * np.clip(v, 0.0, 1.0)) ** 0.7
        fold = 0.35 * np.abs(2 * u - 1) * half
        rise = -droop * v**2 + fold
        return (
            origin
            + v[:, None] * along
            + ((2 * u - 1) * half)[:, None] * across
            + rise[:, None] * np.array([0.0, 0.0, 1.0])
        )

    return points
