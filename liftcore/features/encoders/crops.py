"""Vectors of masks: the crop of each mask from its photo, on black, encoded by the image tower of an open_clip model.

LangSplat and related methods do the same. The vectors share a space with the model's texts, and any tower is
supported, also those without dense features.
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

from liftcore.errors import InvalidInput, reading
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.clip import training_pixels
from liftcore.features.encoders.encode import prepare, read_image
from liftcore.features.masks import labels_alone
from liftcore.io.photos import Reading
from liftcore.runtime.progress import Progress
from liftcore.text.open_clip import OpenedModel, open_model
from liftcore.values.views import check_finite

SPEC = "open_clip:MODEL/TAG or open_clip:MODEL@FILE"
BATCH = 32  # crops encoded at once


class CropEncoder:
    """Encoder of whole images by an open_clip model."""

    def __init__(self, clip_model: OpenedModel, device: torch.device) -> None:
        self.name = clip_model.name
        self.text_space = clip_model.text_space
        self._tower = clip_model.model.visual.to(device).float().eval()
        self._device = device
        side, mean, std, interpolation = training_pixels(clip_model.model, self._tower)
        self.pixels = Pixels(side, side, mean, std, interpolation)  # a crop is one patch

    @classmethod
    def open(cls, spec: str, device: torch.device) -> Self:
        """Load ``open_clip:MODEL/TAG`` or ``open_clip:MODEL@FILE``."""
        kind, _, rest = spec.partition(":")
        if kind != "open_clip" or not rest:
            raise InvalidInput("encoder", expected=SPEC, got=repr(spec))
        return cls(open_model(kind, rest), device)

    def encode(self, images: Tensor) -> Tensor:
        """Encode images [n, 3, side, side] f32, prepared by `pixels`, as unit vectors [n, F] f32 on the CPU."""
        with torch.inference_mode():
            return functional.normalize(self._tower(images.to(self._device)).float(), dim=-1).cpu().clone()


def crop_vectors(
    masks: Mapping[str, Path], photos: Mapping[str, Path], encoder: CropEncoder, unlabelled: int, progress: Progress
) -> tuple[dict[str, np.ndarray], dict[str, Reading]]:
    """Encode the crops of masks: view -> unit vectors [M, F] f16; and view -> the orientation its photo was read in.

    Args:
        masks: view -> file, from `liftcore.features.masks.mask_files`. photos: view -> image.
        unlabelled: value of pixels without a mask in label pictures.
    """
    missing_photos = [view for view in masks if view not in photos]
    if missing_photos:
        got = f"none of {len(missing_photos)} views with masks, such as {missing_photos[0]!r}"
        raise InvalidInput("photos", expected="a photo with the name of each view of masks", got=got)
    vectors, readings = {}, {}
    for count, (view, path) in enumerate(masks.items(), start=1):
        labels, rows = labels_alone(path, unlabelled)
        side = encoder.pixels.shorter
        image, readings[view] = read_image(photos[view], labels.shape[:0:-1])
        crops = (prepare(crop, encoder.pixels, side) for crop in _crops(np.asarray(image), labels, rows, side))
        if not rows:
            vectors[view] = np.zeros((0, 0), np.float16)
            continue
        batches = (torch.stack(list(islice(crops, BATCH))) for _ in range(0, rows, BATCH))
        features = torch.cat([encoder.encode(batch) for batch in batches])
        with reading(f"vectors of the masks of {view!r}", InvalidInput, "finite values"):
            check_finite(features)
        vectors[view] = features.half().numpy()
        progress("encode", count, len(masks), "views")
    return vectors, readings


def _crops(image: np.ndarray, labels: np.ndarray, rows: int, side: int) -> Iterator[Image.Image]:
    """Yield the square crop of each mask of an image [H, W, 3] u8, in the order of their rows."""
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
        lines = np.flatnonzero((down >= tall.start) & (down < tall.stop))
        columns = np.flatnonzero((across >= wide.start) & (across < wide.stop))
        inside = labels[level][np.ix_(down[lines], across[columns])] == row
        masked_crop = np.where(inside[..., None], image[np.ix_(lines, columns)], 0).astype(np.uint8)
        if not masked_crop.size:  # the mask has no pixels, or covers no pixel of the photo
            masked_crop = np.zeros((1, 1, 3), np.uint8)
        yield ImageOps.pad(Image.fromarray(masked_crop), (side, side))
