"""Colours of splats: from a camera, and of their features by three principal components."""

import math

import numpy as np
import torch
from torch import Tensor

from liftcore.query.scores import rows_at_a_time
from liftcore.scene.cameras import Camera
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.splats import Splats
from liftcore.solve.clusters import principal_axes

# Real spherical harmonics, in the field's order and signs (Condon-Shortley phase left in).
SH_C1 = math.sqrt(3 / (4 * math.pi))
SH_C2 = tuple(math.sqrt(c / math.pi) for c in (15 / 4, 5 / 16, 15 / 16))
SH_C3 = tuple(math.sqrt(c / math.pi) for c in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16))
NO_COLOUR = 0.6  # grey of splats whose file holds no colours
_LOBE_SHARPNESS = 10 * math.log(2)
_LARGEST_POWER = 1e30

SAMPLE = 32_768  # rows of which the principal components are computed
SAMPLE_FLOATS = 1 << 26  # most numbers in them: there are fewer rows of very many channels
COMPONENTS = 3
_RANGE = (0.02, 0.98)  # quantiles of the sample that the colours span


def view_colours(splats: Splats, camera: Camera) -> Tensor:
    """Compute colours of splats from a camera, ``max(0, 0.5 + sum_k SH_k(d) c_k + lobes)``, d from camera to splat.

    Args:
        splats: the scene, with spherical harmonics of degree 0 to 3; coefficients above are left out. The lobes of
            DBS are added where the file has them.
        camera: the viewpoint.

    Returns:
        [P, 3] f32, at least zero; grey for splats without colours.
    """
    if splats.sh is None:
        return torch.full((splats.count, 3), NO_COLOUR, dtype=torch.float32)
    centre = torch.from_numpy(np.asarray(camera.about(splats.origin).centre, dtype=np.float32))
    directions = torch.nn.functional.normalize(splats.means - centre, dim=1)
    basis = _sh_basis(directions, min(splats.sh_degree or 0, 3))
    colours = torch.einsum("pk,pkc->pc", basis, splats.sh[:, : basis.shape[1]])
    if splats.sb_params is not None:
        colours += _lobes(directions, splats.sb_params)
    return (colours + 0.5).clamp_min(0.0)


def _lobes(directions: Tensor, sb_params: Tensor) -> Tensor:
    """Compute spherical beta lobes (DBS), ``sum_s softplus(rgb_s) max(0, mu_s d)^(4 exp(b_s))``.

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
    # Powers by logarithms: the exponent may be infinite, and a lobe from behind is 0 at any exponent.
    exponent = (4.0 * b.exp()).clamp_max(_LARGEST_POWER)
    power = (exponent * facing.clamp(1e-30, 1.0).log()).exp()
    return torch.einsum("ps,psc->pc", torch.where(facing > 0, power, 0.0), colour)


def _sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the real spherical harmonics at unit vectors [P, 3], [P, (degree + 1)^2]."""
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


def principal_colours(features: np.ndarray, weights: np.ndarray) -> Tensor:
    """Map the first three principal components of unit features to red, green and blue.

    The components are those of evenly spaced rows with a weight: splats that no ray hits have no influence. Signs are
    fixed (the largest entry of a component is positive), so the same lift has the same colours in every run.

    Args:
        features: [P, F] f16 or f32; zero rows stay black.
        weights: [P] f32 at least zero, such as the total weight.

    Returns:
        [P, 3] f32 in 0..1.
    """
    rows_of = torch.from_numpy(features)
    has_feature = (rows_of != 0).any(dim=1)
    colours = torch.zeros(len(features), COMPONENTS, dtype=torch.float32)
    rows = torch.nonzero(has_feature & (torch.from_numpy(weights) > 0))[:, 0]
    if not len(rows):
        return colours
    sample = _unit(rows_of[rows[:: -(-len(rows) // min(SAMPLE, SAMPLE_FLOATS // features.shape[1] + 1))]])
    centre = sample.mean(dim=0)
    axes = torch.from_numpy(principal_axes((sample - centre).numpy(), COMPONENTS))
    low, high = torch.quantile((sample - centre) @ axes, torch.tensor(_RANGE, dtype=torch.float32), dim=0)
    at_a_time = rows_at_a_time(features.shape[1])
    for first in range(0, len(features), at_a_time):
        block = slice(first, first + at_a_time)
        levels = ((_unit(rows_of[block]) - centre) @ axes - low) / (high - low).clamp_min(1e-12)
        colours[block, : axes.shape[1]] = levels.clamp(0.0, 1.0) * has_feature[block, None]
    return colours


def _unit(rows: Tensor) -> Tensor:
    return torch.nn.functional.normalize(rows.to(torch.float32), dim=1)
