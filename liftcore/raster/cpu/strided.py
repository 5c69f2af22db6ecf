"""Every n-th pixel of a view: coarser pixels whose centres are those of the full view, and footprints to match.

With ``u' = (u - offset - 1/2) / n + 1/2``, whole numbers and a half fall on each other, so the rays of the strided
view are rays of the full one, and its A are rows of the full A: the covariance of a footprint, low-pass included,
shrinks by ``n^2`` as its distances do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import CompositingParams
    from liftcore.raster.cpu.projection import View
    from liftcore.scene.cameras import Camera


def strided(view: View, walk: CompositingParams) -> View:
    """The view that holds the walk's pixels alone; its Jacobian limits stay those of the full view."""
    n, (left, top) = walk.stride, walk.offset
    if n == 1:
        return view
    fx, fy, cx, cy = view.intrinsics
    intrinsics = np.array([fx / n, fy / n, (cx - left - 0.5) / n + 0.5, (cy - top - 0.5) / n + 0.5])
    return view._replace(
        intrinsics=intrinsics,
        width=-(-(view.width - left) // n),
        height=-(-(view.height - top) // n),
        low_pass=view.low_pass / n**2,
    )


def every_pixel(walk: CompositingParams) -> CompositingParams:
    """The walk without its stride: images are whole."""
    return replace(walk, stride=1, offset=(0, 0))


def check_stride(walk: CompositingParams, camera: Camera) -> None:
    """Refuse a stride that leaves no pixel.

    Raises:
        InvalidInput: a stride below one, or a first pixel outside its cell or the image.
    """
    sides = (camera.width, camera.height)
    if walk.stride < 1:
        raise InvalidInput("stride", expected="at least 1", got=str(walk.stride))
    if not all(0 <= first < min(walk.stride, side) for first, side in zip(walk.offset, sides, strict=True)):
        expected = f"a pixel of the image below the stride {walk.stride}"
        raise InvalidInput("offset", expected=expected, got=str(walk.offset))


def places_on(walk: CompositingParams, pixels: Tensor) -> Tensor | None:
    """The pixels [n, 2] (x, y) as pixels of the strided view; None when some are not among its rays."""
    if walk.stride == 1:
        return pixels
    steps = pixels - pixels.new_tensor(walk.offset)
    return None if bool((steps % walk.stride).any()) else steps // walk.stride
