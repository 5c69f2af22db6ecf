"""``splatlift objects``: list the objects of a lift, with names of a vocabulary."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_encoder, add_splats, add_world, world_of
from liftcore.cli.reply import check_outputs, lines_of, outputs_of, reply, write_files
from liftcore.cli.segment import encoder_and_words

if TYPE_CHECKING:
    from liftcore import Scene, TextEncoder
    from liftcore.models import SceneTree


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="names: words, or a text table")
    add_encoder(parser)
    parser.add_argument("--tree", action="store_true", help="list parts and groups too")
    add_world(parser)
    parser.add_argument("--csv", type=Path, metavar="CSV", help="write the objects as a table")
    parser.add_argument("--into", type=Path, metavar="FOLDER", help="write a PLY of each object")
    add_splats(parser)


def run(options: argparse.Namespace) -> int:
    """List the objects, or all nodes of the tree, and write the requested files."""
    files = outputs_of(options)
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, world=world_of(options))
    check_outputs(files, options, scene)
    encoder, tree = named_tree(options, scene)
    exports: dict[str, Any] = {"csv": partial(scene.export, source=tree, content="csv")}
    if not options.tree:
        tree = tree.model_copy(update={"count": len(tree.objects), "nodes": tree.objects})
    names = {node.id: "-".join(["object", *map(str, node.path)]) for node in tree.nodes}
    if options.into:
        files |= {name: options.into / f"{name}.ply" for name in names.values()}
        exports |= {name: partial(scene.export, source=number) for number, name in names.items()}
        check_outputs(files, options, scene)
    document: dict[str, Any] = {"encoder": None if encoder is None else encoder.name}
    document |= {"answer": tree.model_dump(mode="json"), "files": write_files(files, exports)}
    lines = [document["answer"]["explanation"], *lines_of(document)]
    reply(document, as_json=options.json, lines=lines)
    return 0


def named_tree(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, SceneTree]:
    """Return the encoder of the names, None without names; and the lift's objects with parts and groups."""
    encoder, words = _vocabulary(options, scene)
    return encoder, scene.tree(words, encoder=encoder)


def _vocabulary(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, list[str]]:
    """Return the encoder and the words; None and no words if objects get no names."""
    if options.vocabulary is None and not options.table and not options.encoder and scene.table is None:
        return None, []
    if options.vocabulary is not None and options.vocabulary.suffix == ".safetensors":
        encoder = scene.encoder(f"table:{options.vocabulary}")
        return encoder, scene.words(encoder)
    return encoder_and_words(options, scene, options.vocabulary, "--vocabulary")
