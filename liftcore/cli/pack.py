"""``splatlift pack``: convert features and masks of common formats to feature packs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, option_errors
from liftcore.cli.reply import list_folders, reply, short_text

if TYPE_CHECKING:
    from collections.abc import Iterator

OPTIONS = (
    "layout", "map_fit", "unlabelled", "encoder", "photos", "device", "names", "folders", "unannotated",
    "encoder_name", "text_space", "normalised",
)  # options of `pack_folder`  # fmt: skip
NAMES = {
    "normalised": "--no-normalised",
    **{name: f"--{name}" for name in ("device", "encoder", "names", "photos", "unlabelled")},
}  # of arguments
LARGEST_GREY = 65_535  # of a picture of 16 bits


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    formats = parser.add_subparsers(dest="format", required=True, metavar="FORMAT", parser_class=Parser)
    langsplat = formats.add_parser("langsplat", parents=[shared], help="IMG_s.npy and IMG_f.npy")
    arrays = formats.add_parser("npy", parents=[shared], help="IMG.npy (.npz, .pt), one dense map a view")
    axes_help = "the order of the axes, [h, w, F] or [F, h, w]; leading axes of length 1 are removed"
    arrays.add_argument("--layout", choices=("hwc", "chw"), default="hwc", help=axes_help)
    fit_help = (
        "what the encoder's preprocessing did to photos of another shape than its maps: stretched them, padded them "
        "with bars on both sides, or cropped their centre"
    )
    arrays.add_argument("--map-fit", choices=("stretch", "pad", "crop"), help=fit_help)
    masks = formats.add_parser(
        "masks", parents=[shared], help="IMG.npy, one vector a mask, with IMG.json (SAM), IMG_masks.npy or IMG.png"
    )
    masks.add_argument(
        "--unlabelled",
        type=_grey,
        default=0,
        metavar="VALUE",
        help="value of pixels without a mask in label pictures: with 0, value 1 is the first vector; with another "
        "(255), value 0 is the first",
    )
    encoder_help = (
        "compute the vectors from each mask's crop of its photo: open_clip:MODEL/TAG or open_clip:MODEL@FILE"
    )
    masks.add_argument("--encoder", metavar="SPEC", help=encoder_help)
    masks.add_argument(
        "--photos", type=Path, nargs="+", metavar="PATH", help="photos for --encoder, or their folders"
    )
    masks.add_argument("--device", default="cpu", metavar="NAME", help="device of the model, as torch names it")
    prompts = formats.add_parser(
        "prompts",
        parents=[shared],
        help="masks by phrase: PHRASE/VIEW.png, JSON (COCO, Grounded SAM 2), or label pictures with names",
    )
    prompts.add_argument(
        "--names",
        type=Path,
        metavar="FILE",
        help='names of label pictures, JSON from values to names: {"1": "red mug"}',
    )
    folders_help = "names of folders of binary PNGs: phrases (PHRASE/VIEW.png) or views (VIEW/PHRASE.png)"
    prompts.add_argument("--folders", choices=("phrases", "views"), default="phrases", help=folders_help)
    unlabelled_help = "value of unlabelled pixels in pictures (255), which get no label"
    prompts.add_argument("--unlabelled", type=_grey, metavar="VALUE", help=unlabelled_help)
    unannotated_help = (
        "COCO's images without an annotation are omitted (skip), or show none of the phrases (negative)"
    )
    prompts.add_argument("--unannotated", choices=("skip", "negative"), default="skip", help=unannotated_help)
    retag = formats.add_parser("retag", parents=[shared], help="a pack with other names of its encoder or text space")
    space = (
        "the text encoder that shares the space of the features, as for query's --encoder "
        "(open_clip:ViT-B-32/openai), which is the default encoder of queries here and in a service; 'none': no text "
        "encoder shares it, so a lift is queried by example. All packs of a lift must have the same"
    )
    unit = "record that the vectors are unit vectors, or are not; this does not change them"
    for command in (langsplat, arrays, masks, prompts):
        command.add_argument("folder", type=Path, help="the folder of the files")
    retag.add_argument("pack", type=Path, help="the pack to copy")
    for command in (langsplat, arrays, masks, prompts, retag):
        command.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
        command.add_argument("--encoder-name", metavar="NAME", help="name of the encoder of the features or masks")
    for command in (langsplat, arrays, masks, retag):
        command.add_argument("--text-space", metavar="NAME", help=space)
    for command in (langsplat, arrays, masks):
        command.add_argument("--normalised", action=argparse.BooleanOptionalAction, help=unit)


def _grey(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) <= 5 else LARGEST_GREY + 1
    if value > LARGEST_GREY:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to {LARGEST_GREY}, got {text!r}")
    return value


def run(options: argparse.Namespace) -> int:
    """Write the pack, completely or not at all, and describe it."""
    if options.format == "retag":
        return _retag(options)
    from liftcore import pack_folder
    from liftcore.evaluate import inspect_file

    values = {
        name: value
        for name, value in vars(options).items()
        if name in OPTIONS and not (name == "map_fit" and value is None)
    }
    with option_errors(NAMES):
        facts = pack_folder(options.folder, options.output, options.format, **values, progress=True)
    description = inspect_file(options.output, "features")
    names = ("bytes", "views", "channels", "encoder", "text_space", "normalised")
    document = {
        "out": str(options.output),
        **{name: description[name] for name in names},
        "folders": facts["folders"],
        "sizes": description["sizes"],
        "renamed": facts["renamed"],
        "words": facts["words"],
        "warnings": [*facts["warnings"], *description["warnings"]],
    }
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
    yield f"  {short_text(document['sizes'])}"
    if document["words"]:
        yield f"  {len(document['words'])} words: {short_text(document['words'])}"
    yield from list_folders(document["folders"])
    for name, view in list(document["renamed"].items())[:1]:
        yield f"  names of views have no suffix of an image, like those of cameras: {name} is {view!r}"
    yield from (f"warning: {warning}" for warning in document["warnings"])
