"""Whether feature maps have the shape of their images: rows, columns and channels are easily confused."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.scene.cameras import photo_size

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.features.pack import Views
    from liftcore.scene.cameras import Camera

FEW_CELLS = 4  # on a side; of fewer a shape says little
FAR = 2.0  # times wider or narrower than the image: square maps of photos are nearer
CELL = 1  # cells of a map, and pixels of its image, that rounding to whole ones may add or take on a side
TURNED = 1.2  # times nearer to the image's shape when rows and columns are swapped


def shape_warnings(packs: Views, views: Sequence[Camera]) -> list[str]:
    """Warnings where maps are far from the shape of their images or nearer to it when turned, or else stretched.

    Maps of any shape are stretched over their image, as some encoders squeeze images into squares; what they cannot
    be told from is a crop, so no lift is refused.
    """
    odd, stretched = [], []
    for camera in views:
        size = packs.map_size(camera.name)
        if _odd(size, photo_size(camera)):
            odd.append(camera)
        elif _stretched(size, photo_size(camera)):
            stretched.append(camera)
    advice = {
        "of another shape than their images{}: see that they are [rows, columns], channels last": odd,
        "of another aspect than their images{}, over which they are stretched: maps must cover the whole image, and "
        "those of a centre crop do not": stretched,
    }
    return [
        f"{len(found)} of {len(views)} views have maps {text.format(_shapes(packs, found[0]))}"
        for text, found in advice.items()
        if found
    ]


def _shapes(packs: Views, camera: Camera) -> str:
    (width, height), (W, H) = packs.map_size(camera.name), photo_size(camera)
    return f" ({camera.name}: {width}x{height} for {W}x{H})"


def _odd(size: tuple[int, int], photo: tuple[int, int]) -> bool:
    (width, height), (W, H) = size, photo
    if min(width, height) < FEW_CELLS:
        return False
    off, turned = (_factor(ratio * H / W) for ratio in (width / height, height / width))
    return off > FAR or off > TURNED * turned


def _stretched(size: tuple[int, int], photo: tuple[int, int]) -> bool:
    """Whether no scale makes both sides of the image those of the map, to a cell, nor to a pixel of the image."""
    (width, height), (W, H) = size, photo
    wide = (width - CELL) * (H - CELL) > (height + CELL) * (W + CELL)
    return wide or (height - CELL) * (W - CELL) > (width + CELL) * (H + CELL)


def _factor(ratio: float) -> float:
    return max(ratio, 1.0 / ratio)
