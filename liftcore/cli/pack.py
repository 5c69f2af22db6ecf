"""``splatlift pack``: the field's feature formats become feature packs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser
from liftcore.cli.reply import PACK, folders_of, free_output, reply, shown, told_folders, writing
from liftcore.errors import InvalidInput
from liftcore.runtime.progress import progress_bars

if TYPE_CHECKING:
    from collections.abc import Iterator

    from liftcore.features.folders import ViewFolder
    from liftcore.runtime.progress import Progress
    from liftcore.text.table import TableEncoder
    from liftcore.values.views import Regions


LARGEST_GREY = 65_535  # of a picture of 16 bits


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
    from liftcore.evaluate.inspect import describe_packs
    from liftcore.values.pack import read_features, write_pack

    if options.format == "retag":
        return _retag(options)
    with progress_bars() as progress:
        views, table, warnings = _views(options, progress)
        out = free_output(options.output, views.inputs, PACK)
        with writing(out):
            write_pack(out, views, _metadata(options), progress, table)
    packs = read_features(out)
    described = describe_packs(packs)
    document = {
        "out": str(out),
        "bytes": out.stat().st_size,
        "views": len(packs.views),
        "channels": packs.channels,
        "encoder": packs.encoder,
        "text_space": packs.text_space,
        "normalised": packs.normalised,
        "folders": folders_of(views),
        "sizes": described["sizes"],
        "renamed": _renamed(views, options),
        "words": list(table.words) if table else [],
        "warnings": [*warnings, *described["warnings"]],
    }
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _retag(options: argparse.Namespace) -> int:
    """Write the pack under its new names, and say them."""
    from liftcore.io.files import whole_file
    from liftcore.io.safetensors_file import with_metadata
    from liftcore.values.pack import read_features

    given = {"encoder": options.encoder_name, "text_space": options.text_space}
    names = {name: value for name, value in given.items() if value}
    if not names:
        raise InvalidInput("retag", expected="--text-space NAME or --encoder-name NAME", got="neither")
    out = free_output(options.output, [options.pack], PACK)
    read_features(options.pack)  # what is no pack leaves no file
    with writing(out), whole_file(out) as handle:
        handle.writelines(with_metadata(options.pack, names))
    packs = read_features(out)
    document = {"out": str(out), "encoder": packs.encoder, "text_space": packs.text_space}
    said = f"{out}: encoder {packs.encoder or 'not named'}, text space {packs.text_space or 'not named'}"
    reply(document, as_json=options.json, lines=[said])
    return 0


def _renamed(views: ViewFolder, options: argparse.Namespace) -> dict[str, str]:
    """The views that lost the suffix of an image, by their files of vectors."""
    from liftcore.scene.views import IMAGE_SUFFIXES

    if options.format in ("langsplat", "prompts") or getattr(options, "encoder", None):
        return {}
    files = {path.relative_to(options.folder).as_posix(): view for view, path in views.files.items()}
    return {name: view for name, view in files.items() if Path(name).with_suffix("").suffix.lower() in IMAGE_SUFFIXES}


def _lines(document: dict[str, Any]) -> Iterator[str]:
    yield f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    yield f"  {shown(document['sizes'])}"
    if document["words"]:
        yield f"  {len(document['words'])} words: {shown(document['words'])}"
    yield from told_folders(document["folders"])
    for name, view in list(document["renamed"].items())[:1]:
        yield f"  views are named without the suffix of their images, as cameras are: {name} is {view!r}"
    yield from (f"warning: {warning}" for warning in document["warnings"])


def _encoded_masks(options: argparse.Namespace, progress: Progress) -> tuple[ViewFolder[Regions], list[str]]:
    """Masks with vectors of their crops, and warnings.

    What the encoder tells of itself is noted where the caller names nothing.
    """
    from liftcore.features.encoders import device_named
    from liftcore.features.encoders.crops import CropEncoder, crop_vectors
    from liftcore.features.encoders.encode import find_images
    from liftcore.features.masks import mask_files, mask_views
    from liftcore.io.photos import orientation_warnings

    if options.normalised is False:
        raise InvalidInput("--no-normalised", expected="unit vectors, which --encoder makes", got="--no-normalised")
    if not options.photos:
        raise InvalidInput("--photos", expected="the photos that the masks are of, for --encoder", got="none")
    files, photos = mask_files(options.folder), find_images(options.photos)
    free_output(options.output, [*files.values(), *photos.values()], PACK)  # told before the work
    encoder = CropEncoder.open(options.encoder, device_named(options.device))
    vectors, readings = crop_vectors(files, photos, encoder, options.unlabelled, progress)
    options.encoder_name = options.encoder_name or f"crops of masks, {encoder.name}"
    options.text_space = options.text_space or encoder.text_space
    options.normalised = True
    return mask_views(options.folder, options.unlabelled, vectors), orientation_warnings(
        readings, "masks and cameras"
    )


def _views(options: argparse.Namespace, progress: Progress) -> tuple[ViewFolder, TableEncoder | None, list[str]]:
    """The views, words that they bring, and warnings."""
    from liftcore.features import folders

    if options.format == "langsplat":
        return folders.langsplat_views(options.folder), None, []
    if options.format == "npy":
        return folders.array_views(options.folder, options.layout), None, []
    if options.format == "masks":
        from liftcore.features.masks import mask_views

        if options.encoder is not None:
            found, warnings = _encoded_masks(options, progress)
            return found, None, warnings
        if options.photos:
            raise InvalidInput("--encoder", expected="what makes vectors of the masks in --photos", got="none")
        return mask_views(options.folder, options.unlabelled), None, []
    from liftcore.features.prompts import prompt_views

    found = prompt_views(
        options.folder,
        options.names,
        options.folders,
        unlabelled=options.unlabelled,
        unannotated=options.unannotated,
    )
    empty = [phrase for phrase, views in found.counts.items() if not views]
    left_out = [f"no view has a mask of {shown(empty)}: left out"] if empty else []
    return found.views, found.table, [*found.warnings, *left_out]


def _metadata(options: argparse.Namespace) -> dict[str, str]:
    from liftcore.text import OWN_WORDS

    told = {"source": options.format}
    if options.format == "prompts":
        return told | {
            "encoder": options.encoder_name or "masks by prompt",
            "text_space": OWN_WORDS,
            "normalised": "true",
        }
    if options.encoder_name:
        told["encoder"] = options.encoder_name
    if options.text_space:
        told["text_space"] = options.text_space
    if options.normalised is not None:
        told["normalised"] = "true" if options.normalised else "false"
    return told
