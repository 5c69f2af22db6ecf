"""``splatlift encode``: encode images as a feature pack."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, count, option_errors
from liftcore.cli.reply import list_folders, reply
from liftcore.errors import InvalidInput


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("images", type=Path, nargs="+", help="images, or folders of them")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
    parser.add_argument(
        "--encoder",
        required=True,
        metavar="SPEC",
        help="maskclip:MODEL/TAG or timm:NAME; with --weights also maskclip:MODEL",
    )
    parser.add_argument("--weights", type=Path, metavar="FILE", help="file of its weights; the same as ENCODER@FILE")
    cameras_help = (
        "of the images: their sizes decide whether photos with an EXIF orientation are read as stored or rotated"
    )
    parser.add_argument("--cameras", type=Path, metavar="PATH", help=cameras_help)
    parser.add_argument("--size", type=count, metavar="PX", help="the images' shorter side; default: of the model")
    parser.add_argument("--batch", type=count, default=1, metavar="N", help="images encoded at once")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="device of the model, as torch names it")
    parser.add_argument(
        "--normalised", action=argparse.BooleanOptionalAction, default=True, help="normalize features to unit vectors"
    )


def run(options: argparse.Namespace) -> int:
    """Write the pack, completely or not at all, and describe it."""
    from liftcore import encode_images

    spec = options.encoder
    if options.weights:
        kind, _, model = spec.partition(":")
        if "@" in model or (kind != "timm" and "/" in model):
            expected = "an encoder without weights in its name, with --weights"
            raise InvalidInput("--encoder", expected=expected, got=repr(spec), hint=f"{kind}:MODEL, or no --weights")
        spec = f"{spec}@{options.weights}"
    names = ("device", "cameras", "size", "batch", "normalised")
    values = {name: getattr(options, name) for name in names}
    with option_errors({name: f"--{name}" for name in ("encoder", "device", "size")}):
        document = encode_images(options.images, options.output, spec, **values, progress=True)
    line = f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    lines = [line, *list_folders(document["folders"]), *(f"warning: {text}" for text in document["warnings"])]
    reply(document, as_json=options.json, lines=lines)
    return 0
