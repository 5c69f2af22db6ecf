"""``splatlift export``: a lifted scene with its labels, for other programs; the name of the file says the format."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.objects import named_tree
from liftcore.cli.options import Parser, add_encoder, add_lift, add_world, opened_lift, text_encoder, whole
from liftcore.cli.query import made_from
from liftcore.cli.reply import reply, write_files
from liftcore.cli.segment import encoder_and_words
from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from liftcore import Answer, Catalogue, Scene, Segmentation
    from liftcore.models import SceneTree

WHAT = {".json": "masks", ".jsonl": "lines"}  # by the suffix; all others are splats with labels


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_lift(parser)
    made = ".glb, .usdz, .ply or .spz: splats with labels; .json: COCO masks in the views; .jsonl: objects"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=made)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--text", action="append", default=[], metavar="TEXT", help="label what these words find")
    source.add_argument("--words", type=Path, metavar="FILE", help="label every splat by the best of these words")
    source.add_argument("--all-words", action="store_true", help="label every splat by the best word of the encoder")
    source.add_argument("--object", type=whole, metavar="ID", help="one object of the lift, and no other splat")
    only = "with --text: the splats that were found, and no others"
    parted = "of a .usdc or .usdz: a prim an object, in place of a subset of one prim"
    parser.add_argument("--prims", action="store_true", help=parted)
    parser.add_argument("--only", action="store_true", help=only)
    names = "without the options above: name the lift's objects by these words, a file of one a line"
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help=names)
    add_encoder(parser)
    add_world(parser)


def run(options: argparse.Namespace) -> int:
    """Write the scene, and say what is in the file."""
    from liftcore.files import check_output

    suffix = options.output.suffix.lower()
    what = WHAT.get(suffix, "labelled")
    kind = {"masks": "json", "lines": "jsonl"}.get(what, "splats")
    given = [path for path in (options.lift, options.table, options.words, options.vocabulary) if path]
    check_output(options.output, given, kind)
    if options.only and not options.text:
        raise InvalidInput(
            "--only", expected="--text beside it", got="--only alone", hint="--object ID is one object"
        )
    scene = opened_lift(options)
    check_output(options.output, made_from(scene), kind)
    source = _source(options, scene)
    if isinstance(source, int) or options.only:
        what = "object"
    elif suffix == ".splat" or source is None:
        what, source = "splats", None
    if options.prims:
        if what != "labelled" or suffix not in (".usdc", ".usdz"):
            is_usd = suffix in (".usdc", ".usdz")
            got = "splats without labels" if is_usd else f"an output that ends in {suffix or 'no suffix'}"
            raise InvalidInput("--prims", expected="an output of labels that ends in .usdc or .usdz", got=got)
        what = "prims"
    files, exports = {"output": options.output}, {"output": partial(scene.export, source=source, what=what)}
    if what == "labelled" and suffix == ".ply":
        names = options.output.with_name(f"{options.output.name}.json")
        files["names"] = Path(check_output(names, [*given, *made_from(scene)], "json"))
        exports["names"] = partial(scene.export, source=source, what="names")
    files = write_files(files, exports)
    splats = int(scene.members(source).sum()) if isinstance(source, int) else len(scene.features)
    document: dict[str, Any] = {"files": files, "splats": splats, "what": what}
    document["world"] = scene.world.model_dump(mode="json")
    if source is not None and not isinstance(source, int) and what != "object":
        labels = scene.labels(source)
        document |= {
            name: len(labels.document[name]) for name in ("classes", "instances", "nodes") if name in labels.document
        }
    if suffix != ".ply" and what not in WHAT.values() and scene.splats.kernel != "3dgs":
        document["warnings"] = [
            f"{scene.splats.kernel} splats are written as the nearest Gaussians, all that the format has"
        ]
    reply(document, as_json=options.json)
    return 0


def _source(options: argparse.Namespace, scene: Scene) -> Answer | Segmentation | Catalogue | SceneTree | int | None:
    if options.object is not None:
        return int(options.object)
    if options.text:
        return scene.ask(_query(options.text), encoder=text_encoder(options, scene, stand_in=True), places=False)
    if options.words is not None or options.all_words:
        encoder, words = encoder_and_words(options, scene, options.words)
        return scene.segment(words, encoder=encoder, progress=True)
    return None if scene.object is None else named_tree(options, scene)


def _query(texts: list[str]) -> Any:
    from liftcore import Query

    return Query(text=texts)
