"""How far a convolutional network's cells look beside the patches that they stand for.

A strided layer of kernel k, stride s and padding p before it reads around ``s i + (k - 1) / 2 - p``, while the
middle of the pixels that output i covers is ``s i + (s - 1) / 2``. A 3 x 3 convolution of stride 2 and padding 1 so
looks half a pixel up and left, and five of them, as in a ResNet, add up to 15.5 pixels: half a cell. Layers without a
stride are taken as centred, which is what their paddings are for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import nn

if TYPE_CHECKING:
    from torch import Tensor

_STRIDED = (nn.Conv2d, nn.MaxPool2d, nn.AvgPool2d)


def cell_shift(model: nn.Module, images: Tensor) -> float:
    """Pixels that the cells' middles lie up and left of their patches' middles; negative = down and right.

    Where layers stand side by side (a block and its shortcut), their mean counts.

    Args:
        model: called through ``forward_intermediates``, as timm's models are.
        images: [n, 3, H, W] f32, of any content; H a multiple of the stride of every layer.
    """
    at_scale: dict[int, list[float]] = {}  # input pixels a cell -> shifts of the strided layers there, in cells

    def note(module: Any, inputs: tuple[Tensor, ...], _: object) -> None:
        kernel, stride, padding = (_first(part) for part in (module.kernel_size, module.stride, module.padding))
        if type(module).__name__.endswith("Same"):  # TensorFlow's padding, which timm adds as the layer is called
            padding = max(kernel - stride, 0) // 2
        if stride > 1:
            scale = round(images.shape[-2] / inputs[0].shape[-2])
            at_scale.setdefault(scale, []).append((stride - 1) / 2 - ((kernel - 1) / 2 - padding))

    hooks = [module.register_forward_hook(note) for module in model.modules() if isinstance(module, _STRIDED)]
    try:
        with torch.inference_mode():
            model.forward_intermediates(images, indices=1, norm=True, intermediates_only=True)  # pyright: ignore
    finally:
        for hook in hooks:
            hook.remove()
    return sum(scale * sum(shifts) / len(shifts) for scale, shifts in at_scale.items())


def _first(size: Any) -> int:
    return int(size if isinstance(size, int) else size[0])


def shifted(images: Tensor, shift: float, patch: int) -> Tensor:
    """Images [n, 3, H, W] -> [n, 3, H + p, W + p] whose cells, but one row and one column, look where they stand.

    The border's colours go on outside. The row and column to drop are the first ones for a positive shift, else
    the last ones (`kept`).
    """
    before = round(-shift) % patch
    return nn.functional.pad(images, (before, patch - before, before, patch - before), mode="replicate")


def kept(cells: Tensor, shift: float) -> Tensor:
    """The cells [n, h, w, F] of [n, h + 1, w + 1, F] that stand on the image."""
    return cells[:, 1:, 1:] if shift > 0 else cells[:, :-1, :-1]
