"""Images to a feature pack: batches of one size, and one batch in memory."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidInput
from liftcore.features.arrays import ArrayViews
from liftcore.features.encoders.images import prepare, read_image
from liftcore.features.pack import write_pack
from liftcore.features.views import check_finite
from liftcore.progress import Progress, silent

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from torch import Tensor

    from liftcore.features.encoders import ImageEncoder

LARGEST_F16 = 65_504.0


@dataclass(frozen=True)
class EncodeSettings:
    """How images become grids."""

    size: int | None = None  # pixels of the shorter side; None = the encoder's own
    batch: int = 1  # images of one size that go through the model together
    normalised: bool = True  # whether cells become unit vectors (a cell of zeros stays zero)


@dataclass(frozen=True)
class Encoded:
    """What was written."""

    views: int
    turned: tuple[str, ...]  # views whose photos were turned upright as their EXIF says
    wide: tuple[str, ...]  # views that float16 cannot hold, stored as float32


def encode_images(
    images: Mapping[str, Path],
    encoder: ImageEncoder,
    out: Path,
    settings: EncodeSettings,
    progress: Progress = silent,
) -> Encoded:
    """Encode images and write them as a feature pack, whole or not at all.

    Grids wait for the pack on the disk beside it, so memory holds one batch.

    Args:
        images: view name -> image, as `find_images` gives them.
        encoder: of dense features.
        out: the pack to write.
        settings: of the resizing and the batches.
        progress: told about the stages "encode", "check" and "pack", in views.

    Raises:
        InvalidInput: a file is no image, the size is too large or too small, or a feature is not finite.
    """
    patch = encoder.pixels.patch
    if settings.size is not None and settings.size < patch:
        got = f"{settings.size} pixels"
        raise InvalidInput("--size", expected=f"at least a patch, {patch} pixels", got=got)
    turned: list[str] = []
    wide: list[str] = []
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
        files = {name: Path(scratch, f"{number}.npy") for number, name in enumerate(images)}
        done = 0
        for names, batch in _batches(images, encoder, settings, turned):
            for name, grid in zip(names, encoder.encode(batch), strict=True):
                stored = _stored(grid, name, settings)
                if stored.dtype == torch.float32:
                    wide.append(name)
                np.save(files[name], stored.numpy())
            done += len(names)
            progress("encode", done, len(images), "views")
        metadata = {
            "encoder": encoder.name,
            "text_space": encoder.text_space,
            "normalised": "true" if settings.normalised else "false",
        }
        write_pack(out, ArrayViews(files, "hwc"), metadata, progress)
    return Encoded(len(images), tuple(turned), tuple(wide))


def _batches(
    images: Mapping[str, Path], encoder: ImageEncoder, settings: EncodeSettings, turned: list[str]
) -> Iterator[tuple[list[str], Tensor]]:
    """Names and images [n, 3, H, W] of neighbours that share a size; ``turned`` takes the names of turned ones."""
    shorter = settings.size or encoder.pixels.shorter
    names: list[str] = []
    waiting: list[Tensor] = []
    for name, path in images.items():
        image, was_turned = read_image(path)
        if was_turned:
            turned.append(name)
        ready = prepare(image, encoder.pixels, shorter)
        if waiting and (len(waiting) == settings.batch or ready.shape != waiting[0].shape):
            yield names, torch.stack(waiting)
            names, waiting = [], []
        names.append(name)
        waiting.append(ready)
    yield names, torch.stack(waiting)


def _stored(grid: Tensor, name: str, settings: EncodeSettings) -> Tensor:
    """[h, w, F] f16, or f32 where a value is beyond float16."""
    check_finite(grid, f"features of image {name!r}")
    if settings.normalised:
        grid = torch.nn.functional.normalize(grid, dim=-1)
    return grid if float(grid.abs().max()) > LARGEST_F16 else grid.to(torch.float16)
