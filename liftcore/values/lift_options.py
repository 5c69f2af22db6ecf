"""The settings of a lift as keyword arguments, for type checkers and editors: ``lc.lift(..., robust=True)``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypedDict

from liftcore.values.settings import Quality

if TYPE_CHECKING:
    import torch


class LiftOptions(TypedDict, total=False):
    """The fields of `LiftSettings` but the preset, which is an argument of its own; a test holds them equal."""

    quality: Quality | Literal["exact", "balanced", "fast", "draft"]
    top_k: int
    power: int
    gain: float
    alpha_cap: float
    transmittance_stop: float
    antialiased: bool | Literal["auto"]
    stride: int
    view_stride: int
    coverage: int
    view_cosine: float
    levels: Literal["rows"] | int
    robust: bool
    robust_directions: int
    objects: bool | Literal["auto"]
    dtype: Literal["float16", "float32"]
    aggregation: bool
    aggregation_iou: float
    aggregation_cluster_size: int
    diagnostic_rays: int
    seed: int
    smoothness: float
    reference_channels: int
    kernel: Literal["auto", "3dgs", "2dgs", "dbs"]
    device: str | torch.device
