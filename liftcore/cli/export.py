"""``splatlift export`` and ``render``: write a lifted scene, or a picture of it."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli import options as common
from liftcore.cli.reply import check_outputs, reply, write_files
from liftcore.cli.segment import encoder_and_words, named_tree
from liftcore.errors import InvalidInput, InvalidQuery

if TYPE_CHECKING:
    from liftcore import Answer, Scene, Segmentation
    from liftcore.models import SceneTree


def add_arguments(parser: common.Parser) -> None:
    """Add the options of the command."""
    common.add_lift(parser)
    formats = ".glb, .usdz, .ply, .spz, .splat; .json: COCO masks"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=formats)
    source = parser.add_mutually_exclusive_group()
    texts = "label the splats selected by this text"
    source.add_argument("--text", action="append", default=[], metavar="TEXT", help=texts)
    source.add_argument("--words", type=Path, metavar="FILE", help="label every splat with the best word")
    source.add_argument("--all-words", action="store_true", help="likewise, of all words of the encoder")
    source.add_argument("--object", type=common.whole_number, metavar="ID", help="only one object of the lift")
    parser.add_argument("--only", action="store_true", help="with --text: only the selected splats")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="names of the lift's objects")
    common.add_encoder(parser)
    common.add_world(parser)


def add_arguments_render(parser: common.Parser) -> None:
    """Add the options of the command ``render``."""
    from liftcore import Picture

    common.add_lift(parser)
    common.add_view(parser)
    common.add_fields(parser, Picture, ["channel"], {"channel": {"metavar": "NAME"}})
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG", help="the picture to write")


def run(options: argparse.Namespace) -> int:
    """Write the scene, and describe the file."""
    suffix = options.output.suffix.lower()
    content, kind = ("masks", "json") if suffix == ".json" else ("labelled", "splats")
    if options.only and not options.text:
        raise InvalidInput("--only", expected="--text as well", got="no --text", hint="use --object ID")
    files, scene = {"output": options.output}, common.open_lift(options)
    check_outputs(files, options, scene, kind=kind)
    source = _source(options, scene)
    if isinstance(source, int) or options.only:
        content = "object"
    elif suffix in (".splat", ".spz") or source is None:
        content, source = "splats", None
    exports = {"output": partial(scene.export, source=source, content=content)}
    if content == "labelled" and suffix == ".ply":
        files["names"] = options.output.with_name(f"{options.output.name}.json")
        check_outputs(files, options, scene, kind=kind)
        exports["names"] = partial(scene.export, source=source, content="names")
    paths = write_files(files, exports)
    splats = int(scene.members(source).sum()) if isinstance(source, int) else len(scene.features)
    document: dict[str, Any] = {"files": paths, "splats": splats, "content": content}
    document["world"] = scene.world.model_dump(mode="json")
    if source is not None and not isinstance(source, int) and content != "object":
        labels = scene.labels(source)
        document |= {
            name: len(labels.document[name]) for name in ("classes", "instances", "nodes") if name in labels.document
        }
    if suffix != ".ply" and content != "masks" and scene.splats.kernel != "3dgs":
        document["warnings"] = [
            f"{scene.splats.kernel} splats are written as the nearest Gaussians, the only kernel of this format"
        ]
    reply(document, as_json=options.json)
    return 0


def run_render(options: argparse.Namespace) -> int:
    """Render the picture, and print its path."""
    view, files = common.view_of(options), {"output": options.output}
    if view is None:
        raise InvalidQuery("--view", expected="a view to render", got="no --view and no --camera")
    scene = common.open_lift(options)
    check_outputs(files, options, scene)
    paths = write_files(files, {"output": partial(scene.export, content=options.channel, view=view)})
    document = {"channel": options.channel, "out": paths["output"]}
    reply(document, as_json=options.json, lines=[paths["output"]])
    return 0


def _source(options: argparse.Namespace, scene: Scene) -> Answer | Segmentation | SceneTree | int | None:
    from liftcore import Query

    if options.object is not None:
        return int(options.object)
    if options.text:
        query, encoder = Query(text=options.text), common.text_encoder(options, scene, stand_in=True)
        return scene.ask(query, encoder=encoder, places=False)
    if options.words is not None or options.all_words:
        encoder, words = encoder_and_words(options, scene, options.words)
        return scene.segment(words, encoder=encoder, progress=True)
    return None if scene.object is None else named_tree(options, scene)[1]
