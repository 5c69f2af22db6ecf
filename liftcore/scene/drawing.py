"""Rendering of a pinhole resampled to the pixels of a distorted photo."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from liftcore.scene.cameras import Camera, drawn_by
from liftcore.scene.distortion import photo_places

BAND_PIXELS = 1 << 20  # of a distorted photo, carried at a time


def in_photo(camera: Camera, draw: Callable[[Camera], Tensor]) -> Tensor:
    """Resample the picture [H, W, ..] that ``draw`` makes of a pinhole to pixels of a camera's photo, by its lens.

    Without a lens it is as drawn; else floats are interpolated between four pixels, and others are the nearest one's.
    It is zero at the rim of a fisheye's photo that no pinhole sees.
    """
    image = draw(drawn_by(camera))
    if camera.lens is None:
        return image
    width, height, places = camera.lens.width, camera.lens.height, photo_places(camera.lens)
    picture = torch.zeros((height, width, *image.shape[2:]), dtype=image.dtype)
    rows = max(1, BAND_PIXELS // width)
    for first in range(0, height, rows):
        u, v = (torch.from_numpy(axis[first : first + rows]) for axis in places)
        picture[first : first + rows] = _read(image, u, v)
    return picture


def _read(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return [h, w, ..], an image at places [h, w] in its pixels; zero where these lie outside."""
    height, width = image.shape[:2]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = torch.where(inside, u, 0.0), torch.where(inside, v, 0.0)
    shape = (*inside.shape, *(1 for _ in image.shape[2:]))
    if not image.is_floating_point():
        return image[v.long(), u.long()] * inside.reshape(shape)
    output = torch.zeros((*inside.shape, *image.shape[2:]), dtype=image.dtype)
    left, top = (u - 0.5).floor(), (v - 0.5).floor()
    for row in (top, top + 1):
        for column in (left, left + 1):
            share = (1 - (u - 0.5 - column).abs()) * (1 - (v - 0.5 - row).abs()) * inside
            nearest = image[row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long()]
            output += nearest * share.to(image.dtype).reshape(shape)
    return output
