"""Connected components of a mask."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from torch import Tensor


def largest_component(mask: Tensor) -> Tensor:
    """The largest 8-connected component of a mask, the topmost of equals.

    Args:
        mask: [H, W] bool.

    Returns:
        [H, W] bool, empty where the mask is.
    """
    from scipy.ndimage import label

    labels = np.empty(mask.shape, np.int32)
    label(mask.numpy(), structure=np.ones((3, 3)), output=labels)
    sizes = np.bincount(labels.ravel())
    if sizes.size < 3:  # the background and one component at most
        return mask
    sizes[0] = 0  # the background
    if not sizes.any():
        return mask
    return torch.from_numpy(labels == sizes.argmax())
