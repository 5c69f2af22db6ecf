"""Objects on the table: surfaces, colours and numbers of splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.still_life import surfaces

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Piece:
    """One surface of a part of an object."""

    object_name: str
    part: str  # its name
    surface: Callable[[np.ndarray, np.ndarray], np.ndarray]
    colour: tuple[float, float, float]  # sRGB
    splats: int


def still_life_pieces() -> list[Piece]:
    """All pieces, background first. Decimetres, z up, the table top at z = 0, cameras on the side of -y."""
    return [*_background(), *_mug(), *_bowl(), *_fruit(), *_book(), *_lamp(), *_plant()]


def small_things() -> list[Piece]:
    """Return a sword, a ring and a nut near larger objects on a cloth, without a background. Frame as above."""
    cloth = surfaces.rectangle((-4.0, -3.0, 0.0), (8.0, 0.0, 0.0), (0.0, 6.0, 0.0))
    kettle = surfaces.lathe((-1.6, 0.9, 0.0), (0.9, 1.15, 1.0, 0.5, 0.1), (0.0, 0.5, 1.2, 1.7, 1.9))

    def blade(t: np.ndarray) -> np.ndarray:
        return np.stack([-1.2 + 4.4 * t, np.full_like(t, -1.7), np.full_like(t, 0.18)], axis=1)

    def round_(t: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * t
        return np.stack([-2.4 + 0.24 * np.cos(angle), -1.5 + 0.24 * np.sin(angle), np.full_like(t, 0.07)], axis=1)

    sword = surfaces.tube(blade, lambda t: 0.17 - 0.1 * t, (0.0, 0.0, 1.0))
    ring = surfaces.tube(round_, lambda t: np.full_like(t, 0.06), (0.0, 0.0, 1.0))
    nut = surfaces.lathe((0.6, 0.2, 0.0), (0.2, 0.24, 0.24, 0.2), (0.0, 0.08, 0.26, 0.34))
    pear = surfaces.ellipsoid((2.2, 0.9, 0.8), (0.75, 0.75, 0.8))
    steel = (0.66, 0.66, 0.7)
    return [
        Piece("cloth", "cloth", cloth, (0.7, 0.2, 0.2), 3000),
        Piece("kettle", "kettle", kettle, steel, 1300),
        Piece("pear", "pear", pear, (0.7, 0.75, 0.2), 900),
        Piece("sword", "sword", sword, steel, 360),
        Piece("ring", "ring", ring, steel, 90),
        Piece("nut", "nut", nut, steel, 70),
    ]


def _background() -> list[Piece]:
    top = surfaces.rectangle((-7.0, -4.2, 0.0), (14.0, 0.0, 0.0), (0.0, 7.2, 0.0))
    front = surfaces.rectangle((-7.0, -4.2, -0.35), (14.0, 0.0, 0.0), (0.0, 0.0, 0.35))
    return [
        Piece("wall", "wall", _curved_wall, (0.68, 0.76, 0.75), 6000),
        Piece("floor", "floor", surfaces.disc((0.0, 0.0, -4.0), 15.0), (0.45, 0.42, 0.4), 4500),
        Piece("table", "table top", top, (0.7, 0.5, 0.29), 13000),
        Piece("table", "table edge", front, (0.7, 0.5, 0.29), 900),
    ]


def _curved_wall(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    # A hollow half cylinder, wide enough that no camera looks past it; its inside faces the cameras.
    angle = np.pi * (1.25 - 1.5 * u)
    return np.stack([12.0 * np.cos(angle), 10.0 * np.sin(angle) - 3.0, 12.5 * v - 4.2], axis=1)


def _mug() -> list[Piece]:
    x, y = -2.5, -1.5
    outside = surfaces.lathe((x, y, 0), (0.05, 0.5, 0.54, 0.54), (0.0, 0.0, 0.12, 1.25))
    inside = surfaces.lathe((x, y, 0), (0.54, 0.49, 0.48), (1.25, 1.24, 0.1))

    def bow(t: np.ndarray) -> np.ndarray:
        angle = np.pi * (t - 0.5)
        return np.stack(
            [x - 0.5 - 0.42 * np.cos(angle), np.full_like(t, y) - 0.1, 0.64 + 0.38 * np.sin(angle)], axis=1
        )

    handle = surfaces.tube(bow, lambda t: np.full_like(t, 0.095), (0.0, 1.0, 0.0))
    coffee = surfaces.disc((x, y, 1.05), 0.48)
    return [
        Piece("mug", "mug body", outside, (0.16, 0.34, 0.62), 2200),
        Piece("mug", "mug body", inside, (0.93, 0.92, 0.88), 900),
        Piece("mug", "mug body", coffee, (0.24, 0.13, 0.07), 350),
        Piece("mug", "mug handle", handle, (0.16, 0.34, 0.62), 700),
    ]


def _bowl() -> list[Piece]:
    centre = (0.1, -0.1, 0.0)
    outside = surfaces.lathe(centre, (0.1, 0.6, 1.05, 1.35, 1.5), (0.0, 0.02, 0.2, 0.5, 0.85))
    inside = surfaces.lathe(centre, (1.5, 1.43, 1.28, 0.95, 0.05), (0.85, 0.82, 0.5, 0.22, 0.1))
    return [
        Piece("bowl", "bowl", outside, (0.9, 0.88, 0.83), 2600),
        Piece("bowl", "bowl", inside, (0.88, 0.87, 0.83), 1500),
    ]


def _fruit() -> list[Piece]:
    def apple(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        angle, height = 2 * np.pi * u, np.pi * (v - 0.5)
        ring = 0.56 * np.cos(height) * (1.0 + 0.12 * np.sin(height))
        dimple = 0.52 * np.sin(height) - 0.16 * np.exp(-((ring / 0.18) ** 2)) * np.sign(np.sin(height))
        return np.array([-0.55, -0.35, 0.92]) + np.stack([ring * np.cos(angle), ring * np.sin(angle), dimple], axis=1)

    def arc(t: np.ndarray) -> np.ndarray:
        angle = np.pi * (0.1 + 0.8 * t)
        return np.stack(
            [0.2 - 1.15 * np.cos(angle), np.full_like(t, 0.42) + 0.2 * t, 0.85 + 0.85 * np.sin(angle) ** 1.5],
            axis=1,
        )

    def stem(t: np.ndarray) -> np.ndarray:
        return np.stack([-0.55 + 0.08 * t, np.full_like(t, -0.35), 1.28 + 0.32 * t], axis=1)

    banana = surfaces.tube(arc, lambda t: 0.04 + 0.2 * np.sin(np.pi * np.clip(t, 0, 1)) ** 0.55, (0.0, 1.0, 0.0))
    return [
        Piece("red apple", "red apple", apple, (0.75, 0.15, 0.11), 1900),
        Piece(
            "red apple",
            "red apple",
            surfaces.tube(stem, lambda t: np.full_like(t, 0.03), (0, 1, 0)),
            (0.3, 0.2, 0.1),
            80,
        ),
        Piece(
            "orange",
            "orange",
            surfaces.ellipsoid((0.62, -0.42, 0.95), (0.56, 0.56, 0.54)),
            (0.94, 0.52, 0.08),
            1900,
        ),
        Piece("yellow banana", "yellow banana", banana, (0.95, 0.82, 0.22), 1900),
    ]


def _book() -> list[Piece]:
    centre, turn = np.array([2.5, -1.55, 0.0]), np.radians(24.0)
    a = np.array([np.cos(turn), np.sin(turn), 0.0])
    b = np.array([-np.sin(turn), np.cos(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])

    def side(origin: tuple, first: np.ndarray, second: np.ndarray) -> Callable:
        corner = centre + origin[0] * a + origin[1] * b + origin[2] * up
        return surfaces.rectangle(tuple(corner), tuple(first), tuple(second))

    w, h, t = 1.5, 2.1, 0.42
    return [
        Piece("book", "book cover", side((-w / 2, -h / 2, t), w * a, h * b), (0.52, 0.1, 0.12), 2300),
        Piece("book", "book cover", side((-w / 2, h / 2, 0), -h * b, t * up), (0.45, 0.09, 0.1), 500),
        Piece("book", "book pages", side((-w / 2, -h / 2, 0), w * a, t * up), (0.86, 0.82, 0.72), 700),
        Piece("book", "book pages", side((w / 2, -h / 2, 0), h * b, t * up), (0.86, 0.82, 0.72), 700),
    ]


def _lamp() -> list[Piece]:
    centre = (3.2, 1.3, 0.0)
    foot = surfaces.lathe(centre, (0.75, 0.75, 0.6, 0.1, 0.07), (0.0, 0.12, 0.2, 0.32, 0.5))
    pole = surfaces.lathe(centre, (0.07, 0.07), (0.4, 3.3))
    shade = surfaces.lathe(centre, (1.25, 0.62), (2.5, 4.0))
    return [
        Piece("lamp", "lamp post", foot, (0.62, 0.5, 0.26), 900),
        Piece("lamp", "lamp post", pole, (0.66, 0.54, 0.3), 500),
        Piece("lamp", "lamp shade", shade, (0.96, 0.83, 0.54), 2600),
    ]


def _plant() -> list[Piece]:
    x, y = -3.3, 1.2
    pot = surfaces.lathe((x, y, 0), (0.55, 0.62, 0.78, 0.86, 0.86), (0.0, 0.3, 0.95, 1.0, 1.2))
    pieces = [
        Piece("potted plant", "plant pot", pot, (0.66, 0.32, 0.21), 1700),
        Piece("potted plant", "plant pot", surfaces.disc((x, y, 1.1), 0.84), (0.2, 0.14, 0.09), 500),
    ]
    for k in range(15):
        angle = 2.4 * k  # the golden angle, nearly: leaves spread without repeating
        out = 0.75 + 0.55 * ((k * 7) % 5) / 4
        rise = 2.6 - 1.1 * ((k * 3) % 4) / 3
        blade = surfaces.leaf(
            (x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), 1.1),
            (out * np.cos(angle), out * np.sin(angle), rise),
            0.26,
            0.5 * out,
        )
        pieces.append(Piece("potted plant", "plant leaves", blade, (0.22, 0.46, 0.2), 320))
    return pieces
