"""Whether features can be trusted as numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidFeatures

if TYPE_CHECKING:
    from torch import Tensor


def check_finite(values: Tensor, where: str) -> None:
    """Refuse NaN and infinity.

    Raises:
        InvalidFeatures: some value is not finite; the error says where and how many.
    """
    # The extremes carry NaN and infinity along, and cost a tenth of testing every value.
    low, high = torch.aminmax(values) if values.numel() else (torch.zeros(()), torch.zeros(()))
    if not bool(torch.isfinite(low) & torch.isfinite(high)):
        bad = int((~torch.isfinite(values)).sum())
        got = f"{bad} of {values.numel()} that are NaN or infinite"
        raise InvalidFeatures(where, expected="finite values", got=got)
