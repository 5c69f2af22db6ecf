"""``splatlift export``: export a lifted scene with its labels; the suffix of the file is the format."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.objects import named_tree
from liftcore.cli.options import Parser, add_encoder, add_lift, add_world, open_lift, text_encoder, whole_number
from liftcore.cli.reply import check_outputs, reply, write_files
from liftcore.cli.segment import encoder_and_words
from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from liftcore import Answer, Catalogue, Scene, Segmentation
    from liftcore.models import SceneTree

CONTENT_BY_SUFFIX = {".json": "masks"}  # other suffixes: splats with labels


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    add_lift(parser)
    formats = ".glb, .usdz or .ply: splats with labels; .spz or .splat: splats; .json: COCO masks in the views"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=formats)
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--text", action="append", default=[], metavar="TEXT", help="label the splats selected by these words"
    )
    source.add_argument("--words", type=Path, metavar="FILE", help="label every splat with the best of these words")
    source.add_argument("--all-words", action="store_true", help="label every splat with the encoder's best word")
    source.add_argument("--object", type=whole_number, metavar="ID", help="only one object of the lift")
    only_help = "with --text: only the selected splats"
    parser.add_argument("--only", action="store_true", help=only_help)
    vocabulary_help = "without the options above: label the lift's objects with these words, a file with one a line"
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help=vocabulary_help)
    add_encoder(parser)
    add_world(parser)


def run(options: argparse.Namespace) -> int:
    """Write the scene, and describe the file."""
    suffix = options.output.suffix.lower()
    content = CONTENT_BY_SUFFIX.get(suffix, "labelled")
    kind = "json" if content == "masks" else "splats"
    if options.only and not options.text:
        raise InvalidInput(
            "--only", expected="--text as well", got="no --text", hint="use --object ID for one object"
        )
    files, scene = {"output": options.output}, open_lift(options)
    check_outputs(files, options, scene, kind=kind)
    source = _source(options, scene)
    if isinstance(source, int) or options.only:
        content = "object"
    elif suffix in (".splat", ".spz") or source is None:
        content, source = "splats", None
    exports = {"output": partial(scene.export, source=source, what=content)}
    if content == "labelled" and suffix == ".ply":
        files["names"] = options.output.with_name(f"{options.output.name}.json")
        check_outputs(files, options, scene, kind=kind)
        exports["names"] = partial(scene.export, source=source, what="names")
    paths = write_files(files, exports)
    splats = int(scene.members(source).sum()) if isinstance(source, int) else len(scene.features)
    document: dict[str, Any] = {"files": paths, "splats": splats, "what": content}
    document["world"] = scene.world.model_dump(mode="json")
    if source is not None and not isinstance(source, int) and content != "object":
        labels = scene.labels(source)
        document |= {
            name: len(labels.document[name]) for name in ("classes", "instances", "nodes") if name in labels.document
        }
    if suffix != ".ply" and content not in CONTENT_BY_SUFFIX.values() and scene.splats.kernel != "3dgs":
        document["warnings"] = [
            f"{scene.splats.kernel} splats are paths as the nearest Gaussians, the only kernel of this format"
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
