"""``splatlift objects``: list the objects of a lift, with names of a vocabulary."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_encoder, add_splats, add_world, sides_of, world_of
from liftcore.cli.query import source_files
from liftcore.cli.reply import check_outputs, place_of, reply, write_files
from liftcore.cli.segment import encoder_and_words
from liftcore.errors import InvalidQuery
from liftcore.files import check_output, identify

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore import Catalogue, Scene, TextEncoder
    from liftcore.models import SceneTree


RELATIONS = """\
--relations compares the 64 largest objects, and lists each relation of NODE and
OTHER once, with a gap and an overlap:
  touching  their splats touch; gap between the nearest centres
  inside    nine tenths of its splats are in the other's box, which surrounds it
            in two thirds of the directions from its centre; the same gap;
            overlap: the share of its splats in that box
  on        the other is below a third of its footprint, and they touch or
            nearly touch; gap of their heights; overlap: the share of its
            footprint above the other
  under     the other is on it, or higher above it; the same gap; overlap: the
            larger share of either above the other
  beside    their heights overlap by half, and their distance on the ground is
            below the width of the smaller; gap on the ground; overlap: the
            share of the lower one's height
Gaps are in metres if the length of a unit is known, otherwise in scene units.
"""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    vocabulary_help = "name each object by the nearest word of a file, one a line, or of a text table (.safetensors)"
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help=vocabulary_help)
    add_encoder(parser)
    parser.add_argument("--tree", action="store_true", help="list parts and groups too")
    relations_help = (
        "with --tree: spatial relations of objects; on, under and beside only if the up direction is known"
    )
    parser.add_argument("--relations", action="store_true", help=relations_help)
    add_world(parser)
    cameras_help = "instead of --up: the mean up direction of the cameras, for photos taken upright"
    parser.add_argument("--up-of-cameras", action="store_true", help=cameras_help)
    parser.add_argument("--features", action="store_true", help="with --json: the mean feature of each object too")
    parser.add_argument("--csv", type=Path, metavar="CSV", help="write the list as a table")
    parser.add_argument("--into", type=Path, metavar="FOLDER", help="write one PLY for each object, object-ID.ply")
    add_splats(parser)
    parser.appendix = lambda: RELATIONS


def run(options: argparse.Namespace) -> int:
    """List the objects, and write the requested files."""
    _read_splats(options)
    files = {"csv": options.csv} if options.csv else {}
    inputs = [path for path in (options.lift, options.table, options.vocabulary) if path]
    check_outputs(files, inputs)
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, world=world_of(options))
    if files or options.into:
        check_outputs(files, source_files(scene))
    if options.tree:
        return _tree(options, scene)
    encoder, catalogue = named_catalogue(options, scene)
    answer = catalogue.summary(features=options.features)
    document: dict[str, Any] = {"encoder": None if encoder is None else encoder.name}
    document["answer"] = answer.model_dump(mode="json")
    # Deprecated keys, which the next release removes.
    objects = [
        {key: value for key, value in vars(scene_object).items() if (key, value) != ("feature", None)}
        for scene_object in answer.objects
    ]
    document |= {"explanation": catalogue.explanation, "objects": objects}
    exports: dict[str, Any] = {"csv": partial(scene.export, source=catalogue)}
    if options.into:
        for scene_object in catalogue.objects:
            name = f"object-{scene_object.id}"
            files[name] = check_output(options.into / f"{name}.ply", [*inputs, *source_files(scene)], "ply")
            exports[name] = partial(scene.export, source=scene_object.id)
    document["files"] = write_files(files, exports)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _read_splats(options: argparse.Namespace) -> None:
    """Read ``--splats FOLDER`` as ``--into FOLDER``, its name in earlier releases."""
    folder = options.splats
    if not isinstance(folder, Path) or options.into:
        return
    if identify(folder).kind == "splats" if folder.is_dir() else folder.suffix or folder.exists():
        return
    print("splatlift: --splats FOLDER is now --into FOLDER; the next release removes the old name", file=sys.stderr)
    options.into, options.splats = folder, None


def named_catalogue(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, Catalogue]:
    """Return the objects of a lift, named by ``--vocabulary`` or the words of the encoder, and that encoder."""
    encoder, words = _vocabulary(options, scene)
    return encoder, scene.catalogue(words, encoder=encoder)


def named_tree(options: argparse.Namespace, scene: Scene) -> Catalogue | SceneTree:
    """Return the named objects of a lift, with parts and groups if the lift has them."""
    encoder, words = _vocabulary(options, scene)
    return (scene.catalogue if scene.node is None else scene.tree)(words, encoder=encoder)


def _tree(options: argparse.Namespace, scene: Scene) -> int:
    """List the nodes of the tree, and write the requested files."""
    encoder, words = _vocabulary(options, scene)
    if options.csv or options.features:
        option = "--csv" if options.csv else "--features"
        raise InvalidQuery(option, expected="the list of objects", got="--tree", hint="--json has the tree")
    up = "cameras" if options.up_of_cameras else None
    if up and options.up is not None:
        raise InvalidQuery("--up-of-cameras", expected="one of --up and --up-of-cameras", got="both")
    related = options.relations or up is not None or options.up is not None
    answer = scene.tree(words, encoder=encoder, relations=related, up=up)
    files, exports = dict[str, Any](), dict[str, Any]()
    for node in answer.nodes if options.into else ():
        name = "-".join(["object", *map(str, node.path)])
        inputs = [path for path in (options.lift, options.table, options.vocabulary) if path]
        files[name] = check_output(options.into / f"{name}.ply", [*inputs, *source_files(scene)], "ply")
        exports[name] = partial(scene.export, source=node.id)
    document: dict[str, Any] = {"encoder": None if encoder is None else encoder.name}
    document |= {"answer": answer.model_dump(mode="json"), "files": write_files(files, exports)}
    reply(document, as_json=options.json, lines=_tree_lines(document["answer"], document["files"]))
    return 0


def _tree_lines(answer: dict[str, Any], files: dict[str, str]) -> Iterable[str]:
    yield answer["explanation"]
    nodes = {node["id"]: node for node in answer["nodes"]}
    stack = [node["id"] for node in answer["nodes"] if node["parent"] is None][::-1]
    while stack:
        node = nodes[stack.pop()]
        name = "" if node["name"] is None else f" {node['name']} ({node['score']:.3f})"
        yield (
            f"{'  ' * len(node['path'])}{node['id']}{name}, {node['kind']}: {node['splats']} splats, "
            f"{node['share']:.1%} of the total weight, {sides_of(node['size'], answer['unit'])}, masked in "
            f"{node['confidence']:.0%} of the views that see it"
        )
        stack += node["parts"][::-1]
    for relation in answer["relations"]:
        yield (
            f"  {relation['node']} is {relation['relation']} {relation['other']}, with a gap of "
            f"{relation['gap']:.4g} {answer['unit']}"
        )
    yield from (f"  {kind}: {path}" for kind, path in files.items())


def _vocabulary(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, list[str]]:
    """Return the encoder and the words; None and no words if objects get no names."""
    if options.vocabulary is None and not options.table and not options.encoder and scene.table is None:
        return None, []
    if options.vocabulary is not None and options.vocabulary.suffix == ".safetensors":
        encoder = scene.encoder(f"table:{options.vocabulary}")
        return encoder, scene.words(encoder)
    return encoder_and_words(options, scene, options.vocabulary, "--vocabulary")


def _lines(document: dict[str, Any]) -> Iterable[str]:
    yield document["explanation"]
    for entry in document["objects"]:
        low, high = entry["box"]
        name = "" if entry["name"] is None else f" {entry['name']} ({entry['score']:.3f})"
        yield (
            f"  {entry['id']}{name}: {entry['splats']} splats, {entry['share']:.1%} of the total weight, at "
            f"{place_of(entry['centre'])}, from {place_of(low)} to {place_of(high)}, "
            f"{sides_of(entry['size'], document['answer']['unit'])}, best in {', '.join(entry['views'])}"
        )
    yield from (f"  {kind}: {path}" for kind, path in document["files"].items())
