"""Photos as encoders take them: upright, in three colours, resized to whole patches."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError

from liftcore.errors import InvalidInput
from liftcore.features.folder import files_below
from liftcore.scene.views import IMAGE_SUFFIXES, without_image_suffix

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.features.encoders import Pixels

MAX_CELLS = 65_536  # of a grid: attention over more patches takes more memory than a photo is worth
PAPER = (255, 255, 255)  # what shows through transparent pixels: white, as captures without a background have it
ORIENTATION = 0x0112  # EXIF's tag; 1 = upright
_FILTERS = {
    "bicubic": Image.Resampling.BICUBIC,
    "bilinear": Image.Resampling.BILINEAR,
    "lanczos": Image.Resampling.LANCZOS,
    "nearest": Image.Resampling.NEAREST,
}


def find_images(paths: Sequence[Path]) -> dict[str, Path]:
    """View name -> image, of files and folders, sorted by name; an image of a sub-folder is of the view ``camA/000``.

    Raises:
        InvalidInput: nothing is there, a folder has no image, or two images would be the same view.
    """
    found: dict[str, Path] = {}
    for path in paths:
        for file in _images_of(path):
            name = without_image_suffix(file.relative_to(path).as_posix() if path.is_dir() else file.name)
            if found.get(name, file) != file:
                got = f"{found[name]} and {file}"
                raise InvalidInput(
                    "images", expected="one image a view", got=got, hint="a view is named after its image"
                )
            found[name] = file
    return dict(sorted(found.items()))


def _images_of(path: Path) -> list[Path]:
    """The images of a folder and its sub-folders, or the one image that is no folder."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InvalidInput("images", expected="images or folders of images", got=f"nothing at {path}")
    files = [file for file in files_below(path) if not file.name.startswith(".")]
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise InvalidInput(str(path), expected="readable images (.jpg, .png, ...)", got=f"{len(files)} other files")
    return images


def read_image(path: Path) -> tuple[Image.Image, bool]:
    """An image in red, green and blue, upright as its EXIF says, and whether it had to be turned for that.

    Grey images have three equal colours, of 16 bits the upper 8 count, and transparent pixels show white.

    Raises:
        InvalidInput: the file is no image, is cut off, or has more pixels than Pillow opens.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of images between one and two times Pillow's limit, and of odd EXIF
            with Image.open(path) as image:
                turned = image.getexif().get(ORIENTATION, 1) not in (0, 1)
                return _colours(ImageOps.exif_transpose(image)), turned
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise InvalidInput(str(path), expected=f"an image of at most {most} pixels", got="a larger one") from None
    except UnidentifiedImageError:
        raise InvalidInput(str(path), expected="an image", got="a file that Pillow does not know") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's kinds for files that are cut or broken
        raise InvalidInput(str(path), expected="a whole image", got=str(error)[:160]) from None


def _colours(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        wide = np.asarray(image).astype(np.int64)
        high = 255 if wide.max(initial=0) <= 255 else 65_535
        return Image.fromarray((wide.clip(0, high) * 255 // high).astype(np.uint8), "L").convert("RGB")
    if image.mode == "F":
        raise ValueError("grey values as floats, whose white nobody knows")
    if image.has_transparency_data:
        layered = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", layered.size, (*PAPER, 255)), layered).convert("RGB")
    return image.convert("RGB")


def grid_size(width: int, height: int, shorter: int, patch: int) -> tuple[int, int]:
    """Columns and rows of the grid of an image [pixels], its shorter side resized to ``shorter`` pixels.

    Sides are rounded to whole patches, at least one, so that cells tile the image exactly.

    Raises:
        InvalidInput: the grid would be too large.
    """
    scale = shorter / min(width, height) / patch
    columns, rows = (max(1, round(side * scale)) for side in (width, height))
    if columns * rows > MAX_CELLS:
        got = f"{columns}x{rows} for an image of {width}x{height} pixels"
        raise InvalidInput("--size", expected=f"a grid of at most {MAX_CELLS} cells", got=got)
    return columns, rows


def prepare(image: Image.Image, pixels: Pixels, shorter: int) -> Tensor:
    """[3, rows p, columns p] f32: resized to whole patches and normalised."""
    columns, rows = grid_size(*image.size, shorter, pixels.patch)
    size = (columns * pixels.patch, rows * pixels.patch)
    if size != image.size:
        image = image.resize(size, _FILTERS.get(pixels.interpolation, Image.Resampling.BICUBIC))
    colours = torch.from_numpy(np.asarray(image, dtype=np.float32) / 255).permute(2, 0, 1)
    return (colours - torch.tensor(pixels.mean)[:, None, None]) / torch.tensor(pixels.std)[:, None, None]
