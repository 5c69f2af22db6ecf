"""Whether feature maps have the shape of their images: rows, columns and channels are easily confused."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.observe.pack import FeaturePacks
    from liftcore.scene.cameras import Camera

FEW_CELLS = 4  # on a side; of fewer a shape says little
FAR = 2.0  # times wider or narrower than the image: square maps of photos are nearer
TURNED = 1.2  # times nearer to the image's shape when rows and columns are swapped


def shape_warnings(packs: FeaturePacks, views: Sequence[Camera]) -> list[str]:
    """A warning where maps are far from the shape of their images, or nearer to it when turned.

    Maps of any shape are stretched over their image, as encoders squeeze images into squares; so no lift is refused.
    """
    odd = [camera for camera in views if _odd(packs.map_size(camera.name), camera)]
    if not odd:
        return []
    first = odd[0]
    width, height = packs.map_size(first.name)
    shapes = f"{first.name}: {width}x{height} for {first.width}x{first.height}"
    return [
        f"{len(odd)} of {len(views)} views have maps of another shape than their images ({shapes}): see that they are"
        " [rows, columns], channels last"
    ]


def _odd(size: tuple[int, int], camera: Camera) -> bool:
    width, height = size
    if min(width, height) < FEW_CELLS:
        return False
    off, turned = (_factor(ratio * camera.height / camera.width) for ratio in (width / height, height / width))
    return off > FAR or off > TURNED * turned


def _factor(ratio: float) -> float:
    return max(ratio, 1.0 / ratio)
