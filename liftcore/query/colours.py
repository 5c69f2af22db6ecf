"""Colours: of splats as a camera sees them, and of scores as people read them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

# Real spherical harmonics, in the field's order and signs (Condon-Shortley phase left in).
SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
SH_C1 = math.sqrt(3 / (4 * math.pi))
SH_C2 = (
    math.sqrt(15 / (4 * math.pi)),
    math.sqrt(5 / (16 * math.pi)),
    math.sqrt(15 / (16 * math.pi)),
)
SH_C3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)
NO_CLUSTER_COLOUR = (90, 90, 90)  # sRGB of splats in no cluster
NOT_SEEN_COLOUR = (90, 90, 90)  # sRGB of splats without a score
_LOBE_SHARPNESS = 10 * math.log(2)
_LARGEST_POWER = 1e30
NO_COLOUR = 0.6  # grey of splats whose file holds no colours

# The map runs from dark violet over green to light yellow: its lightness rises evenly, so that equal steps of
# score look equal, also in grey.
_MAP_STEPS = 256
_MAP_LIGHTNESS = (0.18, 0.93)
_MAP_HUE = (math.radians(300), math.radians(105))
_MAP_CHROMA = (0.10, 0.17)
_HEAT_RANGE = (0.01, 0.999)  # quantiles that the map spans: one hot pixel dims no picture

_CLUSTER_LIGHTNESS = (0.72, 0.86, 0.58)
_CLUSTER_CHROMA = 0.13


def seen_colours(splats: Splats, camera: Camera) -> Tensor:
    """The colours of splats from a camera, ``max(0, 0.5 + sum_k SH_k(d) c_k + lobes)`` with d from camera to splat.

    Args:
        splats: the scene, with spherical harmonics of degree 0 to 3; coefficients above are left out. The lobes of
            DBS are added where the file has them.
        camera: where they are seen from.

    Returns:
        [P, 3] f32, at least zero; grey for splats without colours.
    """
    if splats.sh is None:
        return torch.full((splats.count, 3), NO_COLOUR)
    centre = torch.from_numpy(np.asarray(camera.centre, dtype=np.float32))
    directions = torch.nn.functional.normalize(splats.means - centre, dim=1)
    basis = _sh_basis(directions, min(splats.sh_degree or 0, 3))
    colours = torch.einsum("pk,pkc->pc", basis, splats.sh[:, : basis.shape[1]])
    if splats.sb_params is not None:
        colours += _lobes(directions, splats.sb_params)
    return (colours + 0.5).clamp_min(0.0)


def _lobes(directions: Tensor, sb_params: Tensor) -> Tensor:
    """Spherical beta lobes (DBS): ``sum_s softplus(rgb_s) max(0, mu_s d)^(4 exp(b_s))``.

    Args:
        directions: [P, 3] f32, unit, from camera to splat.
        sb_params: [P, S, 6] f32, r g b theta phi b of each lobe, with
            ``mu = (sin theta cos phi, sin theta sin phi, cos theta)`` and a softplus of sharpness 10 ln 2.

    Returns:
        [P, 3] f32.
    """
    colour = torch.nn.functional.softplus(sb_params[..., :3], beta=_LOBE_SHARPNESS)
    theta, phi, b = sb_params[..., 3:].unbind(dim=2)
    mu = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=2)
    facing = torch.einsum("psk,pk->ps", mu, directions)
    # Powers by logarithms: the exponent may be infinite, and a lobe seen from behind gives nothing at any exponent.
    exponent = (4.0 * b.exp()).clamp_max(_LARGEST_POWER)
    power = (exponent * facing.clamp(1e-30, 1.0).log()).exp()
    return torch.einsum("ps,psc->pc", torch.where(facing > 0, power, 0.0), colour)


def _sh_basis(directions: Tensor, degree: int) -> Tensor:
    """[P, 3] unit vectors -> [P, (degree + 1)^2] values of the real spherical harmonics."""
    x, y, z = directions.unbind(dim=1)
    terms = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        terms += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        a, b, c = SH_C2
        terms += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e = SH_C3
        terms += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, dim=1)


def colour_map() -> np.ndarray:
    """[256, 3] u8 sRGB, an arc through OKLab (Ottosson 2020) of evenly rising lightness."""
    step = np.linspace(0.0, 1.0, _MAP_STEPS)
    lightness = np.interp(step, (0, 1), _MAP_LIGHTNESS)
    hue = np.interp(step, (0, 1), _MAP_HUE)
    chroma = np.interp(step, (0, 1), _MAP_CHROMA)
    return _srgb(lightness, chroma * np.cos(hue), chroma * np.sin(hue))


def heat_colours(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Scores through the colour map, which spans the known ones from their 1st to their 99.9th percentile.

    Args:
        values: [...] f32. known: [...] bool.

    Returns:
        [..., 3] u8 sRGB, black where not known.
    """
    if not known.any():
        return np.zeros((*values.shape, 3), dtype=np.uint8)
    low, high = np.quantile(values[known], _HEAT_RANGE)
    colours = colour_map()
    level = (values - low) / (high - low) if high > low else np.zeros_like(values)
    picture = colours[np.round(level.clip(0.0, 1.0) * (len(colours) - 1)).astype(np.int64)]
    picture[~known] = 0
    return picture


def constant_terms(colours: np.ndarray) -> np.ndarray:
    """The terms [..., 3] f32 of the spherical harmonics that show colours [..., 3] u8 sRGB, alike from everywhere."""
    return ((colours.astype(np.float32) / 255 - 0.5) / SH_C0).astype(np.float32)


def cluster_colours(count: int) -> np.ndarray:
    """[count + 1, 3] u8 sRGB: a colour a cluster, and grey last, where label -1 points.

    Three levels of lightness take turns. The hues of each turn by the golden angle, so that any first few are far
    apart, and those of neighbouring levels stand a third of it aside.
    """
    turn, level = np.divmod(np.arange(count), len(_CLUSTER_LIGHTNESS))
    hue = (turn + level / len(_CLUSTER_LIGHTNESS)) * math.pi * (3 - math.sqrt(5))
    lightness = np.array(_CLUSTER_LIGHTNESS)[level]
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
