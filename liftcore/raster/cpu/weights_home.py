"""Region weights that lie on a card, brought to the host."""

from __future__ import annotations

from dataclasses import fields

import torch

from liftcore.raster.base import RegionWeights


def on_host(weights: RegionWeights) -> RegionWeights:
    """The same on the host: into pinned memory, all of it at once, for a copy from elsewhere waits for each part."""
    parts = {field.name: getattr(weights, field.name) for field in fields(weights)}
    if not weights.columns.is_cuda:
        return weights
    made = {name: torch.empty(part.shape, dtype=part.dtype, pin_memory=True) for name, part in parts.items()}
    for name, part in parts.items():
        made[name].copy_(part, non_blocking=True)
    torch.cuda.current_stream(weights.columns.device).synchronize()
    return RegionWeights(**made)
