"""Vectors of masks: each mask's crop of its photo, alone on black, through an open_clip model's whole image tower.

That is what LangSplat and its followers do. The vectors share a space with the model's texts, and any tower will do,
also those that give no dense features.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from PIL import Image, ImageOps
from scipy.ndimage import find_objects
from torch import Tensor
from torch.nn import functional

from liftcore.errors import InvalidInput
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.clip import space_of, training_pixels
from liftcore.features.encoders.encode import prepare, read_image
from liftcore.features.masks import labels_alone
from liftcore.io.photos import Reading
from liftcore.runtime.progress import Progress, silent
from liftcore.text.open_clip import OpenedModel, open_model
from liftcore.values.views import check_finite

SPEC = "open_clip:MODEL/TAG or open_clip:MODEL@FILE"
BATCH = 32  # crops that are encoded together


class CropEncoder:
    """An open_clip model's vector of a whole image."""

    def __init__(self, opened: OpenedModel, text_space: str, device: torch.device) -> None:
        self.name = opened.name
        self.text_space = text_space
        self._tower = opened.model.visual.to(device).float().eval()
        self._device = device
        side, mean, std, interpolation = training_pixels(opened.model, self._tower)
        self.pixels = Pixels(side, side, mean, std, interpolation)  # a crop is one patch

    @classmethod
    def open(cls, spec: str, device: torch.device) -> Self:
        """Load ``open_clip:MODEL/TAG`` or ``open_clip:MODEL@FILE``.

        Raises:
            InvalidInput: another specification, an unknown model, or a file that is not weights of it.
            Unavailable: no weights were named, or they cannot be had here.
        """
        kind, _, rest = spec.partition(":")
        if kind != "open_clip" or not rest:
            raise InvalidInput("encoder", expected=SPEC, got=repr(spec))
        opened = open_model(kind, rest)
        return cls(opened, space_of(opened, rest), device)

    def encode(self, images: Tensor) -> Tensor:
        """Images [n, 3, side, side] f32, prepared as `pixels` says -> unit vectors [n, F] f32 on the CPU."""
        with torch.inference_mode():
            return functional.normalize(self._tower(images.to(self._device)).float(), dim=-1).cpu().clone()


def crop_vectors(
    masks: Mapping[str, Path],
    photos: Mapping[str, Path],
    encoder: CropEncoder,
    unlabelled: int = 0,
    progress: Progress = silent,
) -> tuple[dict[str, np.ndarray], dict[str, Reading]]:
    """View -> [M, F] f16, a unit vector for each of its masks; and view -> how its photo was read for them.

    Args:
        masks: view -> file, as `liftcore.features.masks.mask_files` gives them. photos: view -> image.
        unlabelled: what pixels without a mask have in label pictures. progress: told about "encode", in views.

    Raises:
        InvalidInput: a view has no photo, or a photo cannot be read. InvalidFeatures: masks that cannot be read.
    """
    lost = [view for view in masks if view not in photos]
    if lost:
        got = f"none of {len(lost)} views with masks, such as {lost[0]!r}"
        raise InvalidInput("photos", expected="a photo of each view that has masks, named like it", got=got)
    found, readings = {}, {}
    for done, (view, path) in enumerate(masks.items(), start=1):
        labels, rows = labels_alone(path, unlabelled)
        side = encoder.pixels.shorter
        image, readings[view] = read_image(photos[view], labels.shape[:0:-1])
        crops = (prepare(crop, encoder.pixels, side) for crop in _crops(np.asarray(image), labels, rows, side))
        batches = (torch.stack(list(islice(crops, BATCH))) for _ in range(0, rows, BATCH))
        whole = torch.cat([encoder.encode(batch) for batch in batches])
        check_finite(whole, f"vectors of the masks of {view!r}")
        found[view] = whole.half().numpy()
        progress("encode", done, len(masks), "views")
    return found, readings


def _crops(image: np.ndarray, labels: np.ndarray, rows: int, side: int) -> Iterator[Image.Image]:
    """The square picture of each mask of an image [H, W, 3] u8, in the order of their rows."""
    (height, width), (h, w) = image.shape[:2], labels.shape[1:]
    down = (np.arange(height) * h) // height
    across = (np.arange(width) * w) // width
    boxes: dict[int, tuple[int, Any]] = {}
    for level, plane in enumerate(labels):
        for row, box in enumerate(find_objects(plane + 1)):
            if box is not None:
                boxes[row] = level, box
    for row in range(rows):
        level, (tall, wide) = boxes.get(row, (0, (slice(0), slice(0))))
        here = np.flatnonzero((down >= tall.start) & (down < tall.stop))
        there = np.flatnonzero((across >= wide.start) & (across < wide.stop))
        inside = labels[level][np.ix_(down[here], across[there])] == row
        alone = np.where(inside[..., None], image[np.ix_(here, there)], 0).astype(np.uint8)
        if not alone.size:  # no pixels of the mask, or none of the photo
            alone = np.zeros((1, 1, 3), np.uint8)
        yield ImageOps.pad(Image.fromarray(alone), (side, side))
