"""Whether features can be trusted as numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidFeatures

if TYPE_CHECKING:
    from torch import Tensor

LARGEST = 1e15  # float32 sums of squares over all channels stay finite far beyond


def check_finite(values: Tensor, where: str) -> None:
    """Refuse NaN, infinity, and what no encoder gives and whose squares would be infinite.

    Raises:
        InvalidFeatures: some value is not finite or too large; the error says where and how many.
    """
    # The extremes carry NaN and infinity along, and cost a tenth of testing every value.
    low, high = torch.aminmax(values) if values.numel() else (torch.zeros(()), torch.zeros(()))
    if not (float(low) >= -LARGEST and float(high) <= LARGEST):  # in float64: float16 would take the bound for inf
        bad = int((~(values.float().abs() <= LARGEST)).sum())
        got = f"{bad} of {values.numel()} that are NaN, infinite or larger"
        raise InvalidFeatures(where, expected=f"finite values within +-{LARGEST:g}", got=got)
