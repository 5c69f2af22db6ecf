"""Colours of scores and clusters: perceptually even arcs through OKLab (Ottosson 2020)."""

import math

import numpy as np

NO_CLUSTER_COLOUR = (90, 90, 90)  # sRGB of splats in no cluster
NOT_SEEN_COLOUR = (90, 90, 90)  # sRGB of splats without a score

# The map runs from dark violet over green to light yellow: its lightness rises evenly, so that equal steps of
# score look equal, also in grey.
_MAP_STEPS = 256
_MAP_LIGHTNESS = (0.18, 0.93)
_MAP_HUE = (math.radians(300), math.radians(105))
_MAP_CHROMA = (0.10, 0.17)
_HEAT_RANGE = (0.01, 0.999)  # quantiles that the map spans: one high outlier does not darken the picture

_CLUSTER_LIGHTNESS = (0.72, 0.86, 0.58, 0.79)
_CLUSTER_CHROMA = 0.13
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def colour_map() -> np.ndarray:
    """Return [256, 3] u8 sRGB, an arc through OKLab (Ottosson 2020) of evenly rising lightness."""
    step = np.linspace(0.0, 1.0, _MAP_STEPS)
    lightness = np.interp(step, (0, 1), _MAP_LIGHTNESS)
    hue = np.interp(step, (0, 1), _MAP_HUE)
    chroma = np.interp(step, (0, 1), _MAP_CHROMA)
    return _srgb(lightness, chroma * np.cos(hue), chroma * np.sin(hue))


def heat_colours(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Colour scores by the map, which spans the valid ones from their 1st to their 99.9th percentile.

    Args:
        values: [...] f32. valid: [...] bool, True where there is a score.

    Returns:
        [..., 3] u8 sRGB, black where not valid.
    """
    if not valid.any():
        return np.zeros((*values.shape, 3), dtype=np.uint8)
    low, high = np.quantile(values[valid], _HEAT_RANGE)
    return map_colours((values - low) / (high - low) if high > low else np.zeros_like(values), valid)


def map_colours(level: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Colour levels [...] from 0 to 1 by the map, [..., 3] u8 sRGB; black where not valid."""
    colours = colour_map()
    picture = colours[np.round(level.clip(0.0, 1.0) * (len(colours) - 1)).astype(np.int64)]
    picture[~valid] = 0
    return picture


def cluster_colours(count: int) -> np.ndarray:
    """Return a colour a cluster, and grey last for label -1, [count + 1, 3] u8 sRGB.

    Hues are a golden angle apart, so that any number of them in a row differ; four values of lightness alternate.
    """
    number = np.arange(count)
    hue, lightness = number * _GOLDEN_ANGLE, np.array(_CLUSTER_LIGHTNESS)[number % len(_CLUSTER_LIGHTNESS)]
    colours = _srgb(lightness, _CLUSTER_CHROMA * np.cos(hue), _CLUSTER_CHROMA * np.sin(hue))
    return np.concatenate([colours, np.array([NO_CLUSTER_COLOUR], dtype=np.uint8)])


def _srgb(lightness: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = np.stack(
        [
            4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
            -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
            -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
        ],
        axis=-1,
    ).clip(0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)
