"""Sums over all views: the evidence and the denominators of the splats, wherever the views' weights lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn.functional import embedding_bag

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import RegionWeights


class Totals:
    """[P] f64 each, added view by view in their order. On a card they lie there, and no view waits for the host.

    A splat is in a view once, so no two threads add to it.

    Args:
        count: P. place: where they are added; weights from elsewhere are brought there, whatever they cost.
        by_torch: whether rows are summed as on a card; None asks the place.
    """

    def __init__(self, count: int, place: torch.device, by_torch: bool | None = None) -> None:
        self._by_torch = place.type != "cpu" if by_torch is None else by_torch
        self._evidence, self._denominators = (torch.zeros(count, dtype=torch.float64, device=place) for _ in range(2))

    def add(self, weights: RegionWeights, rays: float) -> None:
        """Add a view: all of it, or nothing where the place has no room for what that takes.

        Args:
            rays: of the full view that each walked ray stands for.
        """
        if not self._by_torch:
            self._evidence.numpy()[weights.evidence_splats.numpy()] += weights.evidence.numpy().astype(float) * rays
            self._denominators.numpy()[weights.splats.numpy()] += row_totals(weights)
            return
        place = self._evidence.device
        met, seen = weights.evidence_splats.to(place).long(), weights.splats.to(place).long()
        evidence = self._evidence[met] + weights.evidence.to(place).double() * rays
        values, starts = weights.weights.to(place).double(), weights.indptr.to(place)
        denominators = self._denominators[seen] + sums_in_order(values, starts)
        self._evidence[met] = evidence  # from here on nothing is allocated
        self._denominators[seen] = denominators

    def found(self) -> tuple[np.ndarray, np.ndarray]:
        """Evidence and denominators, on the host."""
        return self._evidence.cpu().numpy(), self._denominators.cpu().numpy()


def row_totals(weights: RegionWeights) -> np.ndarray:
    """[n] f64, ``W 1``: the sum of each row, of weights on the host."""
    if weights.splats.numel() == 0:
        return np.zeros(0)
    return np.add.reduceat(weights.weights.numpy().astype(np.float64), weights.indptr.numpy()[:-1])


def sums_in_order(values: Tensor, starts: Tensor) -> Tensor:
    """Sums [n] f64 of values f64 between ``starts`` [n + 1] i64: one thread each, one value after the other."""
    if values.numel() == 0:
        return values.new_zeros(starts.shape[0] - 1)
    every = torch.arange(values.shape[0], device=values.device)
    return embedding_bag(every, values[:, None], starts, mode="sum", include_last_offset=True)[:, 0]
