"""``splatlift pack`` and ``encode``: make feature packs of features and masks, or of images."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, count, option_errors, whole_number
from liftcore.cli.reply import list_folders, reply, short_text

if TYPE_CHECKING:
    from collections.abc import Iterator

OPTIONS = (
    "layout", "map_fit", "unlabelled", "encoder", "photos", "device", "names", "unannotated",
    "encoder_name", "text_space", "normalised",
)  # options of `pack_folder`  # fmt: skip
NAMES = {
    "normalised": "--no-normalised",
    **{name: f"--{name}" for name in ("device", "encoder", "names", "photos", "unlabelled")},
}  # of arguments
GREY = partial(whole_number, largest=65_535, expected="a whole number from 0 to 65535")  # of a picture of 16 bits


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    formats = parser.add_subparsers(dest="format", required=True, metavar="FORMAT", parser_class=Parser)
    langsplat = formats.add_parser("langsplat", parents=[shared], help="IMG_s.npy and IMG_f.npy")
    arrays = formats.add_parser("npy", parents=[shared], help="IMG.npy (.npz, .pt), one dense map a view")
    arrays.add_argument("--layout", choices=("hwc", "chw"), default="hwc", help="of the axes; default hwc")
    fit = "what the encoder did to photos of another shape"
    fits = ("stretch", "pad", "pad-end", "crop")
    arrays.add_argument("--map-fit", choices=fits, default=argparse.SUPPRESS, help=fit)
    masks = formats.add_parser("masks", parents=[shared], help="IMG.npy, a vector a mask, with JSON or pictures")
    unlabelled = "of pixels without a mask"
    masks.add_argument("--unlabelled", type=GREY, default=0, metavar="VALUE", help=f"{unlabelled}; default 0")
    masks.add_argument("--encoder", metavar="SPEC", help="of the vectors of crops: open_clip:MODEL/TAG")
    photos = "photos of --encoder, or their folders"
    masks.add_argument("--photos", type=Path, nargs="+", metavar="PATH", help=photos)
    masks.add_argument("--device", default="cpu", metavar="NAME", help="of the model, as torch names it")
    prompts = formats.add_parser("prompts", parents=[shared], help="masks by phrase: PHRASE/VIEW.png or JSON")
    prompts.add_argument("--names", type=Path, metavar="FILE", help='of values, JSON: {"1": "red mug"}')
    prompts.add_argument("--unlabelled", type=GREY, metavar="VALUE", help=unlabelled)
    unannotated = "images: left out, or without phrases"
    prompts.add_argument("--unannotated", choices=("skip", "negative"), default="skip", help=unannotated)
    retag = formats.add_parser("retag", parents=[shared], help="a pack with other names of its encoder or text space")
    for command in (langsplat, arrays, masks, prompts):
        command.add_argument("folder", type=Path, help="the folder of the files")
    retag.add_argument("pack", type=Path, help="the pack to copy")
    for command in (langsplat, arrays, masks, prompts, retag):
        command.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
        command.add_argument("--encoder-name", metavar="NAME", help="of the features or masks")
    for command in (langsplat, arrays, masks, retag):
        command.add_argument("--text-space", metavar="NAME", help="the text encoder of the space, or none")
    for command in (langsplat, arrays, masks):
        unit = "the vectors have unit length, or not"
        command.add_argument("--normalised", action=argparse.BooleanOptionalAction, help=unit)


def add_arguments_encode(parser: Parser) -> None:
    """Add the options of the command ``encode``."""
    parser.add_argument("images", type=Path, nargs="+", help="images, or folders of them")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
    spec = "maskclip:MODEL/TAG, maskclip:MODEL@FILE or timm:NAME"
    parser.add_argument("--encoder", required=True, metavar="SPEC", help=spec)
    parser.add_argument("--cameras", type=Path, metavar="PATH", help="whose sizes say how photos are turned")
    parser.add_argument("--size", type=count, metavar="PX", help="the shorter side; default: of the model")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="of the model, as torch names it")
    unit = "make unit vectors; the default"
    parser.add_argument("--normalised", action=argparse.BooleanOptionalAction, default=True, help=unit)


def run(options: argparse.Namespace) -> int:
    """Write the pack, completely or not at all, and describe it."""
    if options.format == "retag":
        return _retag(options)
    from liftcore import pack_folder
    from liftcore.evaluate import inspect_file

    values = {name: value for name, value in vars(options).items() if name in OPTIONS}
    with option_errors(NAMES):
        facts = pack_folder(options.folder, options.output, options.format, **values, progress=True)
    description = inspect_file(options.output, "features")
    names = ("bytes", "views", "channels", "encoder", "text_space", "normalised", "sizes")
    document = {"out": str(options.output), **{name: description[name] for name in names}}
    document |= {name: facts[name] for name in ("folders", "words")}
    document["warnings"] = [*facts["warnings"], *description["warnings"]]
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def run_encode(options: argparse.Namespace) -> int:
    """Write the pack, completely or not at all, and describe it."""
    from liftcore import encode_images

    names = ("device", "cameras", "size", "normalised")
    values = {name: getattr(options, name) for name in names}
    with option_errors({name: f"--{name}" for name in ("encoder", "device", "size")}):
        document = encode_images(options.images, options.output, options.encoder, **values, progress=True)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _retag(options: argparse.Namespace) -> int:
    """Write the pack with its new names, and print them."""
    from liftcore import read_features, retag_pack

    names = {"encoder": options.encoder_name, "text_space": options.text_space}
    with option_errors({"names": "--text-space or --encoder-name"}):
        retag_pack(options.pack, options.output, {name: value for name, value in names.items() if value})
    packs = read_features(options.output)
    document = {"out": str(options.output), "encoder": packs.encoder, "text_space": packs.text_space}
    line = f"{options.output}: encoder {packs.encoder or 'not named'}, text space {packs.text_space or 'not named'}"
    reply(document, as_json=options.json, lines=[line])
    return 0


def _lines(document: dict[str, Any]) -> Iterator[str]:
    yield f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    if "sizes" in document:
        yield f"  {short_text(document['sizes'])}"
    if document.get("words"):
        yield f"  {len(document['words'])} words: {short_text(document['words'])}"
    yield from list_folders(document["folders"])
    yield from (f"warning: {warning}" for warning in document["warnings"])
