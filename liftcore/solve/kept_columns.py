"""W without the columns of some regions: dropping masks and solving again touches no pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.solve.totals import row_totals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.solve.view_weights import WeightStore


def kept_columns(store: WeightStore, kept: Sequence[np.ndarray | None], count: int) -> tuple[WeightStore, np.ndarray]:
    """The weights of the kept regions alone, and their sums a splat, [P] f64.

    Args:
        store: W of every view. It stays as it is; the result shares its columns, so it must stay open.
        kept: [M_v] bool of every view, which codebook rows count; None keeps a view whole.
        count: P.
    """
    fewer, denominators = store.blank(), np.zeros(count)
    for weights, target, rows in zip(store, fewer, kept, strict=True):
        counts = torch.ones_like(target.weights) if rows is None else torch.from_numpy(rows)[weights.columns.long()]
        torch.mul(weights.weights, counts, out=target.weights)
        denominators[weights.splats.numpy()] += row_totals(target)
    return fewer, denominators
