"""``splatlift encode``: images become a feature pack, through an image encoder."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, count, renamed
from liftcore.cli.reply import reply, told_folders
from liftcore.errors import InvalidInput


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
    from liftcore import encode_images

    spec = options.encoder
    if options.weights:
        kind, _, named = spec.partition(":")
        if "@" in named or (kind != "timm" and "/" in named):
            expected = "an encoder that names no weights itself, beside --weights"
            raise InvalidInput("--encoder", expected=expected, got=repr(spec), hint=f"{kind}:MODEL, or no --weights")
        spec = f"{spec}@{options.weights}"
    names = ("device", "cameras", "size", "batch", "normalised")
    values = {name: getattr(options, name) for name in names}
    with renamed({name: f"--{name}" for name in ("encoder", "device", "size")}):
        document = encode_images(options.images, options.output, spec, **values, progress=True)
    line = f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    lines = [line, *told_folders(document["folders"]), *(f"warning: {text}" for text in document["warnings"])]
    reply(document, as_json=options.json, lines=lines)
    return 0
