"""Encoding of photos as a feature pack: in RGB, resized to whole patches, one by one.

Photos are read in the orientation of their cameras (`liftcore.io.photos`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from liftcore.errors import InvalidFeatures, InvalidInput, reading
from liftcore.features.encoders import ImageEncoder, Pixels, open_image_encoder
from liftcore.features.folders import files_below, folders_of, grids_of
from liftcore.io.cameras import read_cameras
from liftcore.io.files import check_output, writing
from liftcore.io.photos import ORIENTATION, Reading, header_of, open_photo, orientation_warnings
from liftcore.runtime.arguments import as_path, as_paths
from liftcore.runtime.folders import scratch_folder
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.cameras import Cameras
from liftcore.scene.views import IMAGE_SUFFIXES, cameras_of_views, require_name, without_image_suffix
from liftcore.values.pack import write_pack
from liftcore.values.views import check_finite

LARGEST_F16 = 65_504.0
MAX_CELLS = 65_536  # of a grid: attention over more patches needs too much memory
TURNED_BACK = {6: 8, 8: 6}  # of the turns that EXIF has, those that are not their own inverse
PAPER = (255, 255, 255)  # the colour behind transparent pixels: white, as in captures without a background


def encode_images(
    images: Path | str | Sequence[Path | str],
    out: Path | str,
    encoder: ImageEncoder | str,
    *,
    device: str = "cpu",
    cameras: Cameras | Path | str | None = None,
    size: int | None = None,
    normalised: bool = True,
    progress: Progress | bool | None = None,
) -> dict[str, Any]:
    """Encode photos and write them as a feature pack, completely or not at all.

    Grids are stored in a temporary folder next to the pack first, so memory holds one photo.

    Args:
        images: images, and folders of them; a view has the name of its image.
        out: path of the pack.
        encoder: the encoder, or its specification as for `open_image_encoder`.
        device: of an encoder opened by its specification, as torch names it.
        cameras: of the photos, or their file: their sizes decide whether photos with an EXIF orientation are read as
            stored or rotated.
        size: pixels of the shorter side; None: the encoder's default.
        normalised: True: cells become unit vectors (a cell of zeros stays zero).
        progress: as for `liftcore.lift`.

    Returns:
        A dictionary for JSON that describes the pack, with ``warnings``.

    Raises:
        InvalidInput: a file is not an image, the size is too large or too small, a feature is not finite, the pack
            cannot be written, or the specification is invalid.
        Unavailable: the weights, or the device, are not on this machine.
    """
    photos = find_images(images)
    if not photos:
        raise InvalidInput("images", expected="images or folders of images", got="none")
    check_output(out, list(photos.values()), "pack")
    model = open_image_encoder(encoder, device) if isinstance(encoder, str) else encoder
    if size is not None and size < model.pixels.patch:
        expected = f"at least a patch, {model.pixels.patch} pixels"
        raise InvalidInput("size", expected=expected, got=f"{size} pixels")
    if isinstance(cameras, Path | str):
        cameras = read_cameras(cameras)
    pairs = cameras_of_views(photos, cameras or ())
    sizes = {photo: cameras[name].photo_size for photo, name in pairs.items()} if cameras else {}
    file, readings, wide = as_path(out, "output"), dict[str, Reading](), list[str]()
    with shown_progress(progress) as reporter, writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(f".{file.name}.", file.parent) as scratch:
            files = {name: scratch / f"{number}.npy" for number, name in enumerate(photos)}
            shorter = size or model.pixels.shorter
            for count, (name, path) in enumerate(photos.items(), start=1):
                image, readings[name] = read_image(path, sizes.get(name))
                (grid,) = model.encode(prepare(image, model.pixels, shorter)[None])
                with reading(f"features of image {name!r}", InvalidFeatures, "finite values"):
                    check_finite(grid)
                cells = torch.nn.functional.normalize(grid, dim=-1) if normalised else grid
                if float(cells.abs().max()) > LARGEST_F16:
                    wide.append(name)
                else:
                    cells = cells.to(torch.float16)
                np.save(files[name], cells.numpy())
                reporter("encode", count, len(photos), "views")
            names = {"encoder": model.name, "text_space": model.text_space}
            write_pack(file, grids_of(files), names | {"normalised": str(normalised).lower()}, reporter)
        size_bytes = file.stat().st_size
    warnings = orientation_warnings(readings, "their cameras")
    if wide:
        warnings.append(f"{len(wide)} views have features beyond float16 and are stored as float32")
    if model.text_space == "none":
        warnings.append("these features have no text space: query a lift of them by example")
    return {
        "out": str(out),
        "bytes": size_bytes,
        "views": len(photos),
        "folders": folders_of(photos),
        "channels": model.channels,
        "patch": model.pixels.patch,
        "size": size or model.pixels.shorter,
        **names,
        "normalised": normalised,
        "warnings": warnings,
    }


def find_images(paths: Path | str | Sequence[Path | str]) -> dict[str, Path]:
    """Return view name -> image of files and folders, sorted by name; views of sub-folders are named ``camA/000``."""
    images: dict[str, Path] = {}
    for path in as_paths(paths, "images"):
        for file in _images_of(path):
            name = without_image_suffix(file.relative_to(path).as_posix() if path.is_dir() else file.name)
            require_name(name, "images", InvalidInput)
            if images.get(name, file) != file:
                got = f"{images[name]} and {file}"
                raise InvalidInput(
                    "images", expected="one image a view", got=got, hint="a view has the name of its image"
                )
            images[name] = file
    return dict(sorted(images.items()))


def _images_of(path: Path) -> list[Path]:
    """List the images of a folder and its sub-folders, or the image itself."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InvalidInput("images", expected="images or folders of images", got=f"nothing at {path}")
    files = files_below(path)
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise InvalidInput(str(path), expected="readable images (.jpg, .png, ...)", got=f"{len(files)} other files")
    return images


def read_image(path: Path | str, size: tuple[int, int] | None = None) -> tuple[Image.Image, Reading]:
    """Read an RGB image as stored or as rotated by its EXIF orientation (`liftcore.io.photos`), and return which.

    Grey images have three equal colours, of 16 bits the upper 8 are used, and transparent pixels become white.

    Args:
        path: of the image. size: width and height of its camera or masks, of any resolution; None: unknown.
    """
    with open_photo(Path(path)) as image:
        header = header_of(image)
        orientation = header.reading(size)
        image.load()
        if image.format == "TIFF" and orientation is Reading.STORED:  # which Pillow turned as it was loaded
            image.getexif()[ORIENTATION] = TURNED_BACK.get(header.orientation, header.orientation)
            return _colours(ImageOps.exif_transpose(image)), orientation
        return _colours(ImageOps.exif_transpose(image) if orientation is Reading.ORIENTED else image), orientation


def _colours(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        wide = np.asarray(image).astype(np.int64)
        high = 255 if wide.max(initial=0) <= 255 else 65_535
        return Image.fromarray((wide.clip(0, high) * 255 // high).astype(np.uint8), "L").convert("RGB")
    if image.mode == "F":
        raise ValueError("grey values as floats, whose white level is unknown")
    if image.has_transparency_data:
        layered = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", layered.size, (*PAPER, 255)), layered).convert("RGB")
    return image.convert("RGB")


def grid_size(width: int, height: int, shorter: int, patch: int) -> tuple[int, int]:
    """Return columns and rows of the grid of an image [pixels] whose shorter side is resized to ``shorter`` pixels.

    Sides are rounded to whole patches, at least one, so that cells tile the image exactly.
    """
    scale = shorter / min(width, height) / patch
    columns, rows = (max(1, round(side * scale)) for side in (width, height))
    if columns * rows > MAX_CELLS:
        got = f"{columns}x{rows} for an image of {width}x{height} pixels"
        raise InvalidInput("size", expected=f"a grid of at most {MAX_CELLS} cells", got=got)
    return columns, rows


def prepare(image: Image.Image, pixels: Pixels, shorter: int) -> Tensor:
    """Resize an image to whole patches and normalize its colours, [3, rows p, columns p] f32."""
    columns, rows = grid_size(*image.size, shorter, pixels.patch)
    size = (columns * pixels.patch, rows * pixels.patch)
    if size != image.size:
        resampling = getattr(Image.Resampling, pixels.interpolation.upper(), Image.Resampling.BICUBIC)
        image = image.resize(size, resampling)
    colours = torch.from_numpy(np.asarray(image, dtype=np.float32) / 255).permute(2, 0, 1)
    return (colours - torch.tensor(pixels.mean)[:, None, None]) / torch.tensor(pixels.std)[:, None, None]
