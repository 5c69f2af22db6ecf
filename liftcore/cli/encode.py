"""``splatlift encode``: images become a feature pack, through an image encoder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, count
from liftcore.cli.reply import PACK, folders_of, free_output, reply, told_folders, writing
from liftcore.errors import InvalidInput
from liftcore.runtime.progress import progress_bars

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.features.encoders import ImageEncoder
    from liftcore.features.encoders.encode import Encoded


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("images", type=Path, nargs="+", help="images, or folders of them")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
    parser.add_argument(
        "--encoder",
        required=True,
        metavar="SPEC",
        help="maskclip:MODEL/TAG, clip:MODEL/TAG or timm:NAME; with --weights also maskclip:MODEL or clip:MODEL",
    )
    parser.add_argument(
        "--weights", type=Path, metavar="FILE", help="the file of its weights; the same as ENCODER@FILE"
    )
    whose = "of the images: their sizes tell whether photos with an EXIF orientation are read as stored or turned"
    parser.add_argument("--cameras", type=Path, metavar="PATH", help=whose)
    parser.add_argument("--size", type=count, metavar="PX", help="the images' shorter side; else the model's own")
    parser.add_argument("--batch", type=count, default=1, metavar="N", help="images that are encoded together")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="where the model runs, as torch names it")
    parser.add_argument(
        "--normalised", action=argparse.BooleanOptionalAction, default=True, help="unit vectors, or as they come"
    )


def run(options: argparse.Namespace) -> int:
    """Write the pack whole or not at all, and say what is in it."""
    from liftcore.features.encoders import open_image_encoder
    from liftcore.features.encoders.encode import EncodeSettings, encode_images, find_images

    images = find_images(options.images)
    out = free_output(options.output, list(images.values()), PACK)
    spec = options.encoder
    if options.weights:
        kind, _, named = spec.partition(":")
        if "@" in named or (kind != "timm" and "/" in named):
            expected = "an encoder that names no weights itself, beside --weights"
            raise InvalidInput("--encoder", expected=expected, got=repr(spec), hint=f"{kind}:MODEL, or no --weights")
        spec = f"{spec}@{options.weights}"
    encoder = open_image_encoder(spec, options.device)
    settings = EncodeSettings(options.size, options.batch, options.normalised)
    sizes = _camera_sizes(options.cameras, images) if options.cameras else {}
    with progress_bars() as progress, writing(out):
        encoded = encode_images(images, encoder, out, settings, progress, sizes)
    document = {
        "out": str(out),
        "bytes": out.stat().st_size,
        "views": encoded.views,
        "folders": folders_of(images),
        "channels": encoder.channels,
        "patch": encoder.pixels.patch,
        "size": options.size or encoder.pixels.shorter,
        "encoder": encoder.name,
        "text_space": encoder.text_space,
        "normalised": options.normalised,
        "warnings": _warnings(encoded, encoder),
    }
    line = f"{out}: {encoded.views} views, {encoder.channels} channels, {document['bytes']} bytes"
    lines = [line, *told_folders(document["folders"])]
    reply(document, as_json=options.json, lines=[*lines, *(f"warning: {text}" for text in document["warnings"])])
    return 0


def _camera_sizes(path: Path, images: Mapping[str, Path]) -> dict[str, tuple[int, int]]:
    """Image name -> width and height of its camera's photo, of those that have one."""
    from liftcore.io.cameras import read_cameras
    from liftcore.scene.cameras import photo_sizes

    return photo_sizes(images, read_cameras(path, views=list(images)))


def _warnings(encoded: Encoded, encoder: ImageEncoder) -> list[str]:
    from liftcore.io.photos import orientation_warnings

    found: list[Any] = orientation_warnings(encoded.readings, "their cameras")
    if encoded.wide:
        found.append(f"{len(encoded.wide)} views have features beyond float16 and are stored as float32")
    if encoder.text_space == "none":
        found.append("these features have no words: a lift of them is asked by example")
    return found
