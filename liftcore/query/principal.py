"""Features as colours: their three principal components, for people who look before they read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.query.scores import rows_at_a_time
from liftcore.solve.principal_axes import principal_axes

if TYPE_CHECKING:
    from torch import Tensor

SAMPLE = 32_768  # rows that decide the components
SAMPLE_FLOATS = 1 << 26  # of them at most: rows of very many channels are fewer
SEED = 0
COMPONENTS = 3
_RANGE = (0.02, 0.98)  # weighted-sample quantiles that the colours span


def principal_colours(features: Tensor, weights: Tensor) -> Tensor:
    """The first three principal components of unit features as red, green and blue.

    The components are those of a seeded sample of the rows, drawn with the weights as odds: splats that no ray
    meets decide nothing. Signs are fixed (the largest entry of a component is positive), so the same lift has the
    same colours at every run.

    Args:
        features: [P, F] f16 or f32; zero rows stay black.
        weights: [P] f32 at least zero, such as the evidence.

    Returns:
        [P, 3] f32 in 0..1.
    """
    known = (features != 0).any(dim=1)
    odds = torch.where(known, weights.to(torch.float32), 0.0)
    colours = torch.zeros(features.shape[0], COMPONENTS)
    if not bool((odds > 0).any()):
        return colours
    rows = _draw(odds, max(COMPONENTS, min(SAMPLE, SAMPLE_FLOATS // features.shape[1])))
    sample = _unit(features[rows])
    centre = sample.mean(dim=0)
    axes = torch.from_numpy(principal_axes((sample - centre).numpy(), COMPONENTS))
    shown = (sample - centre) @ axes
    low, high = torch.quantile(shown, torch.tensor(_RANGE), dim=0)
    at_a_time = rows_at_a_time(features.shape[1])
    for first in range(0, features.shape[0], at_a_time):
        block = slice(first, first + at_a_time)
        levels = ((_unit(features[block]) - centre) @ axes - low) / (high - low).clamp_min(1e-12)
        colours[block, : axes.shape[1]] = levels.clamp(0.0, 1.0) * known[block, None]
    return colours


def _draw(odds: Tensor, count: int) -> Tensor:
    """Seeded rows [count] i64 with probabilities proportional to the odds [P] (inverse of the running sum)."""
    running = torch.cumsum(odds.double(), dim=0)
    marks = torch.rand(count, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64) * running[-1]
    return torch.searchsorted(running, marks, right=True).clamp_max(len(odds) - 1)


def _unit(rows: Tensor) -> Tensor:
    return torch.nn.functional.normalize(rows.to(torch.float32), dim=1)
