"""``splatlift pack``: the field's feature formats become feature packs."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, renamed
from liftcore.cli.reply import reply, shown, told_folders

if TYPE_CHECKING:
    from collections.abc import Iterator

OPTIONS = (
    "layout", "unlabelled", "encoder", "photos", "device", "names", "folders", "unannotated", "encoder_name",
    "text_space", "normalised",
)  # options that `pack_folder` takes  # fmt: skip
NAMES = {
    "normalised": "--no-normalised",
    **{name: f"--{name}" for name in ("device", "encoder", "names", "photos", "unlabelled")},
}  # of arguments
LARGEST_GREY = 65_535  # of a picture of 16 bits
MASK_LAYOUTS = """\
layouts of FOLDER: vectors IMG.npy [M, F] of each image, unless --encoder makes
them, with one of
  IMG.json              SAM's generator with output_mode uncompressed_rle or
                        coco_rle, SA-1B's files, or polygons
  IMG_masks.npy (.npz)  booleans [M, H, W] or [M, 1, H, W], or ids [H, W] or
                        [L, H, W] with -1 for none
  IMG.png               a label picture of 8 or 16 bits or a palette: value v has
                        row v - 1, and 0 means none; with --unlabelled 255 (or
                        another value) that one means none, and v has row v

Masks may overlap: the largest come first, each on the first level with its
pixels free; more than 32 levels are refused. Hidden files, Thumbs.db and the
like are left out.
"""
ARRAY_LAYOUTS = """\
layouts of FOLDER: maps IMG.npy or IMG.jpg.npy, also .npz of one array and .pt of
one tensor, read as tensors only, so no code runs. feature-3dgs'
IMG_fmap_CxHxW.pt has its channels first. Hidden files, Thumbs.db and the like
are left out.
"""
PROMPT_LAYOUTS = """\
layouts of FOLDER, with sub-folders where views have some:
  PHRASE/VIEW.png       binary pictures, or arrays [h, w] in .npy or .npz; with
                        --folders views VIEW/PHRASE.png. _ is a space
  *.json of COCO        images, annotations and categories (CVAT, Label Studio,
                        Roboflow), LVIS, SA-Co's text_input, YouTube-VIS
  *.json, one an image  records with a phrase, label or class_name and run
                        lengths, polygons or pictures: Grounded SAM 2, LabelMe,
                        ISAT, Supervisely, Darwin. The view is that of its
                        image_path, else of its own name
  json_data, mask_data  the tracking of Grounded SAM 2: pictures of ids and
                        their class names; also DEVA, COCO's panoptic pictures
  VIEW.png (.npy)       label pictures. Those of 'segment --labels' bring their
                        names; else --names FILE: JSON from values to names or
                        back (id2label, COCO's categories), .csv or .tsv of
                        values and names, a name a line (a first "background"
                        is 0), "1 name" or "1,name" a line, CVAT's labelmap.txt

Masks of one phrase in a view are merged. Polygons are filled within a pixel of
pycocotools, on the image's width and height. In a view with a file, pixels
without a mask count as none of the phrases, but have no label where SA-Co or
LVIS say that the image was not searched for every phrase. Annotations with
boxes alone are counted in a warning, and their inside has no label.
"""


def add_arguments(parser: Parser, shared: Parser) -> None:
    """The options of the command."""
    formats = parser.add_subparsers(dest="format", required=True, metavar="FORMAT", parser_class=Parser)
    langsplat = formats.add_parser("langsplat", parents=[shared], help="IMG_s.npy and IMG_f.npy")
    arrays = formats.add_parser("npy", parents=[shared], help="IMG.npy (.npz, .pt), a dense map a view")
    by = "the order of the axes, [h, w, F] or [F, h, w]; axes of length 1 before them are taken off"
    arrays.add_argument("--layout", choices=("hwc", "chw"), default="hwc", help=by)
    masks = formats.add_parser(
        "masks", parents=[shared], help="IMG.npy, a vector a mask, with IMG.json (SAM's), IMG_masks.npy or IMG.png"
    )
    masks.add_argument(
        "--unlabelled",
        type=_grey,
        default=0,
        metavar="VALUE",
        help="of label pictures, the value that means no mask: 0, and value 1 is of the first vector; with another "
        "(255) value 0 is of the first",
    )
    by = "make the vectors: of each mask's crop of its photo, open_clip:MODEL/TAG or open_clip:MODEL@FILE"
    masks.add_argument("--encoder", metavar="SPEC", help=by)
    masks.add_argument("--photos", type=Path, nargs="+", metavar="PATH", help="of --encoder, or their folders")
    masks.add_argument("--device", default="cpu", metavar="NAME", help="where the model runs, as torch names it")
    prompts = formats.add_parser(
        "prompts",
        parents=[shared],
        help="masks by phrase: PHRASE/VIEW.png, JSON (COCO's, Grounded SAM 2's), or named label pictures",
    )
    prompts.add_argument(
        "--names", type=Path, metavar="FILE", help="of label pictures, JSON from values to names, or a name a line"
    )
    by = "what folders of binary PNGs are named by: phrases (PHRASE/VIEW.png) or views (VIEW/PHRASE.png)"
    prompts.add_argument("--folders", choices=("phrases", "views"), default="phrases", help=by)
    by = "of pictures, the value of pixels of which nobody decided what they show (255), which get no label"
    prompts.add_argument("--unlabelled", type=_grey, metavar="VALUE", help=by)
    by = "COCO's images without an annotation are left out (skip), or show none of the phrases (negative)"
    prompts.add_argument("--unannotated", choices=("skip", "negative"), default="skip", help=by)
    for command, layouts in ((arrays, ARRAY_LAYOUTS), (masks, MASK_LAYOUTS), (prompts, PROMPT_LAYOUTS)):
        command.appendix = partial(str, layouts)
    retag = formats.add_parser("retag", parents=[shared], help="a pack under other names of its encoder or space")
    space = (
        "the text encoder whose words lie in the space of the features, as query's --encoder names it "
        "(open_clip:ViT-B-32/openai): query opens it where no encoder is given, and a service takes the one that it "
        "has under that name; 'none': no text encoder shares it, so a lift is asked by example. Packs of one lift "
        "must agree"
    )
    unit = "say that the vectors are unit vectors, or are not; this changes none of them"
    for command in (langsplat, arrays, masks, prompts):
        command.add_argument("folder", type=Path, help="the folder of the files")
    retag.add_argument("pack", type=Path, help="the pack as it is")
    for command in (langsplat, arrays, masks, prompts, retag):
        command.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
        command.add_argument("--encoder-name", metavar="NAME", help="what made the features or masks")
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
    """Write the pack whole or not at all, and say what is in it."""
    if options.format == "retag":
        return _retag(options)
    from liftcore import pack_folder
    from liftcore.evaluate import inspect_file

    values = {name: value for name, value in vars(options).items() if name in OPTIONS}
    with renamed(NAMES):
        facts = pack_folder(options.folder, options.output, options.format, **values, progress=True)
    described = inspect_file(options.output, "features")
    names = ("bytes", "views", "channels", "encoder", "text_space", "normalised")
    document = {
        "out": str(options.output),
        **{name: described[name] for name in names},
        "folders": facts["folders"],
        "sizes": described["sizes"],
        "renamed": facts["renamed"],
        "words": facts["words"],
        "warnings": [*facts["warnings"], *described["warnings"]],
    }
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _retag(options: argparse.Namespace) -> int:
    """Write the pack under its new names, and say them."""
    from liftcore import read_features, retag_pack

    names = {"encoder": options.encoder_name, "text_space": options.text_space}
    with renamed({"names": "--text-space or --encoder-name"}):
        retag_pack(options.pack, options.output, {name: value for name, value in names.items() if value})
    packs = read_features(options.output)
    document = {"out": str(options.output), "encoder": packs.encoder, "text_space": packs.text_space}
    line = f"{options.output}: encoder {packs.encoder or 'not named'}, text space {packs.text_space or 'not named'}"
    reply(document, as_json=options.json, lines=[line])
    return 0


def _lines(document: dict[str, Any]) -> Iterator[str]:
    yield f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    yield f"  {shown(document['sizes'])}"
    if document["words"]:
        yield f"  {len(document['words'])} words: {shown(document['words'])}"
    yield from told_folders(document["folders"])
    for name, view in list(document["renamed"].items())[:1]:
        yield f"  views are named without the suffix of their images, as cameras are: {name} is {view!r}"
    yield from (f"warning: {warning}" for warning in document["warnings"])
