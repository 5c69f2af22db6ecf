"""Paints: the colour of a surface point before the light falls on it.

A paint maps points [n, 3] (world, decimetres) and parameters [n, 2] (0..1 along the surface) to sRGB [n, 3]
in 0..1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]


def plain(red: float, green: float, blue: float) -> Paint:
    """One colour all over."""
    return lambda points, parameters: np.tile([red, green, blue], (len(points), 1))


def wood(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Planks along x, with grain that bends around a few knots."""
    x, y, _ = points.T
    plank = np.floor((y + 10.0) / 1.2)
    shift = 7.3 * np.sin(12.9 * plank)
    bend = 0.25 * np.sin(0.7 * x + shift) + 0.12 * np.sin(1.9 * x + 2.0 * shift)
    grain = 0.5 + 0.5 * np.sin(22.0 * (y + bend) + 3.0 * np.sin(0.9 * x + shift))
    tone = 0.9 + 0.1 * np.sin(5.1 * plank)
    seam = np.abs((y + 10.0) / 1.2 - plank - 0.5) > 0.475
    colour = _between((0.63, 0.42, 0.24), (0.78, 0.56, 0.34), grain) * tone[:, None]
    return np.where(seam[:, None], 0.55 * colour, colour)


def plaster(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """A wall of two tones with a pale band between, and a slow mottle."""
    x, _, z = points.T
    mottle = 0.5 + 0.25 * np.sin(1.3 * x + 0.7 * z) + 0.25 * np.sin(0.8 * z - 1.9 * x)
    upper = _between((0.66, 0.74, 0.73), (0.71, 0.78, 0.77), mottle)
    lower = _between((0.38, 0.49, 0.52), (0.42, 0.53, 0.56), mottle)
    colour = np.where((z > 1.2)[:, None], upper, lower)
    return np.where((np.abs(z - 1.1) < 0.16)[:, None], [0.9, 0.89, 0.84], colour)


def tiles(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """A floor of two greys, checked."""
    odd = (np.floor(points[:, 0] / 2.0) + np.floor(points[:, 1] / 2.0)) % 2
    return _between((0.35, 0.33, 0.31), (0.55, 0.52, 0.48), odd)


def glaze(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Blue with two white rings."""
    height = points[:, 2]
    ring = (np.abs(height - 0.85) < 0.09) | (np.abs(height - 0.4) < 0.05)
    return np.where(ring[:, None], [0.93, 0.92, 0.88], [0.16, 0.34, 0.62])


def ceramic(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Off-white with a green rim and a row of dots."""
    angle = 2 * np.pi * parameters[:, 0]
    height = points[:, 2]
    rim = height > 0.74
    dots = (np.cos(16 * angle) > 0.4) & (np.abs(height - 0.5) < 0.1)
    return np.where((rim | dots)[:, None], [0.2, 0.47, 0.4], [0.9, 0.88, 0.83])


def apple_skin(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Red with a yellow cheek and fine streaks from pole to pole."""
    angle = 2 * np.pi * parameters[:, 0]
    cheek = np.clip(0.5 + 0.6 * np.cos(angle - 4.4), 0, 1) ** 3
    streak = 0.5 + 0.5 * np.sin(31 * angle)
    return _between((0.72, 0.07, 0.09), (0.9, 0.66, 0.22), 0.75 * cheek + 0.1 * streak)


def orange_peel(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Orange with dimples."""
    x, y, z = 24.0 * points.T
    return _between((0.9, 0.45, 0.04), (0.98, 0.58, 0.12), 0.5 + 0.5 * np.sin(x) * np.sin(y) * np.sin(z))


def banana_peel(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Yellow with brown ends and a few freckles."""
    u, v = parameters.T
    ends = np.clip((np.abs(v - 0.5) - 0.44) / 0.04, 0, 1)
    freckle = (np.sin(91 * v + 40 * u) * np.sin(57 * u - 23 * v) > 0.93).astype(float)
    return _between((0.95, 0.82, 0.22), (0.35, 0.24, 0.1), np.maximum(ends, 0.6 * freckle))


def book_cover(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Dark red with a gold frame and two lines of title."""
    u, v = parameters.T
    frame = (np.maximum(np.abs(u - 0.5), np.abs(v - 0.5)) > 0.41) & (
        np.maximum(np.abs(u - 0.5), np.abs(v - 0.5)) < 0.445
    )
    title = (np.abs(u - 0.5) < 0.28) & ((np.abs(v - 0.7) < 0.035) | (np.abs(v - 0.6) < 0.025))
    return np.where((frame | title)[:, None], [0.88, 0.72, 0.34], [0.52, 0.1, 0.12])


def pages(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """The cut edges of paper between two covers."""
    height = parameters[:, 1]
    paper = _between((0.78, 0.73, 0.6), (0.93, 0.9, 0.8), 0.5 + 0.5 * np.sin(60 * height))
    return np.where((np.abs(height - 0.5) > 0.42)[:, None], [0.45, 0.09, 0.1], paper)


def shade_cloth(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Warm cloth with pleats and two darker hems."""
    u, v = parameters.T
    cloth = _between((0.93, 0.78, 0.48), (0.98, 0.87, 0.6), 0.5 + 0.5 * np.sin(2 * np.pi * 24 * u))
    return np.where((np.abs(v - 0.5) > 0.455)[:, None], [0.7, 0.5, 0.26], cloth)


def terracotta(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Fired clay, lighter at the rim."""
    return _between((0.62, 0.29, 0.18), (0.76, 0.4, 0.27), points[:, 2] > 0.98)


def leaf_green(points: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Green, lighter along the middle rib and towards the tip."""
    u, v = parameters.T
    rib = np.exp(-(((u - 0.5) / 0.08) ** 2))
    return _between((0.1, 0.34, 0.14), (0.45, 0.65, 0.27), np.clip(0.6 * rib + 0.35 * v, 0, 1))


def _between(first: tuple, second: tuple, share: np.ndarray) -> np.ndarray:
    """Colours from the first (0) to the second (1)."""
    amount = np.asarray(share, dtype=float)[:, None]
    return (1 - amount) * np.array(first) + amount * np.array(second)
