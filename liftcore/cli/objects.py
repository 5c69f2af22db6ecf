"""``splatlift objects``: the things that a lift holds, found without a word; a vocabulary names them."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_encoder, add_splats, add_world, place, sides_of, world_of
from liftcore.cli.query import made_from
from liftcore.cli.reply import free_outputs, place_of, reply, write_files
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
  touching  splats of them touch; the gap of the nearest centres
  inside    nine tenths of its splats lie in the other's box, which lies in two
            thirds of the directions from its middle; gap likewise, overlap the
            share of its splats in that box
  on        the other lies below a third of its footprint, and they touch or
            nearly do; the gap of their heights, the share of its footprint
            above the other
  under     the other is on it, or begins higher above it; gap likewise, the
            larger share of either above the other
  beside    heights overlap by half, and on the ground they are less apart than
            the smaller is wide; the gap on the ground, the share of the lower
            one's height
Gaps are in metres where the length of a unit is known, else in scene units.
"""


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("lift", type=place, help="a lift (.safetensors)")
    named = "name each by the nearest of these words: a file of one a line, or a text table (.safetensors)"
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help=named)
    add_encoder(parser)
    parser.add_argument("--tree", action="store_true", help="their parts and groups of them, too")
    lying = "with --tree: how objects lie to each other; where it is known which way is up, also what is on what"
    parser.add_argument("--relations", action="store_true", help=lying)
    add_world(parser)
    held = "in place of --up: that of the cameras, whose photos were taken upright"
    parser.add_argument("--up-of-cameras", action="store_true", help=held)
    parser.add_argument("--features", action="store_true", help="with --json: each one's mean feature, too")
    parser.add_argument("--csv", type=Path, metavar="CSV", help="write the list as a table")
    parser.add_argument("--into", type=Path, metavar="FOLDER", help="write one PLY an object, object-ID.ply")
    add_splats(parser)
    parser.appendix = lambda: RELATIONS


def run(options: argparse.Namespace) -> int:
    """List the objects, and write what was asked for."""
    _read_splats(options)
    files = {"csv": options.csv} if options.csv else {}
    given = [path for path in (options.lift, options.table, options.vocabulary) if path]
    free_outputs(files, given)
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, world=world_of(options))
    if files or options.into:
        free_outputs(files, made_from(scene))
    if options.tree:
        return _tree(options, scene)
    encoder, found = named_catalogue(options, scene)
    answer = found.summary(features=options.features)
    document: dict[str, Any] = {"encoder": None if encoder is None else encoder.name}
    document["answer"] = answer.model_dump(mode="json")
    # The keys of before, which go with the next release.
    objects = [
        {key: value for key, value in vars(one).items() if (key, value) != ("feature", None)}
        for one in answer.objects
    ]
    document |= {"explanation": found.explanation, "objects": objects}
    exports: dict[str, Any] = {"csv": partial(scene.export, source=found)}
    if options.into:
        for one in found.objects:
            name = f"object-{one.id}"
            files[name] = check_output(options.into / f"{name}.ply", [*given, *made_from(scene)], "ply")
            exports[name] = partial(scene.export, source=one.id)
    document["files"] = write_files(files, exports)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _read_splats(options: argparse.Namespace) -> None:
    """Take ``--splats`` with a folder, as releases before called ``--into``, for that."""
    folder = options.splats
    if not isinstance(folder, Path) or options.into:
        return
    if identify(folder).kind == "splats" if folder.is_dir() else folder.suffix or folder.exists():
        return
    print("splatlift: --splats FOLDER is now --into FOLDER; the old name goes with the next release", file=sys.stderr)
    options.into, options.splats = folder, None


def named_catalogue(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, Catalogue]:
    """The objects of a lift, named by ``--vocabulary`` or the words of the encoder, and that encoder."""
    encoder, words = _vocabulary(options, scene)
    return encoder, scene.catalogue(words, encoder=encoder)


def named_tree(options: argparse.Namespace, scene: Scene) -> Catalogue | SceneTree:
    """The same with their parts and groups, of a lift that has them."""
    encoder, words = _vocabulary(options, scene)
    return (scene.catalogue if scene.node is None else scene.tree)(words, encoder=encoder)


def _tree(options: argparse.Namespace, scene: Scene) -> int:
    """List the nodes of the tree, and write what was asked for."""
    encoder, words = _vocabulary(options, scene)
    if options.csv or options.features:
        named = "--csv" if options.csv else "--features"
        raise InvalidQuery(named, expected="the list of objects", got="--tree", hint="--json has the tree")
    up = "cameras" if options.up_of_cameras else None
    if up and options.up is not None:
        raise InvalidQuery("--up-of-cameras", expected="one of --up and --up-of-cameras", got="both")
    related = options.relations or up is not None or options.up is not None
    answer = scene.tree(words, encoder=encoder, relations=related, up=up)
    files, exports = dict[str, Any](), dict[str, Any]()
    for one in answer.nodes if options.into else ():
        name = "-".join(["object", *map(str, one.path)])
        given = [path for path in (options.lift, options.table, options.vocabulary) if path]
        files[name] = check_output(options.into / f"{name}.ply", [*given, *made_from(scene)], "ply")
        exports[name] = partial(scene.export, source=one.id)
    document: dict[str, Any] = {"encoder": None if encoder is None else encoder.name}
    document |= {"answer": answer.model_dump(mode="json"), "files": write_files(files, exports)}
    reply(document, as_json=options.json, lines=_tree_lines(document["answer"], document["files"]))
    return 0


def _tree_lines(answer: dict[str, Any], files: dict[str, str]) -> Iterable[str]:
    yield answer["explanation"]
    nodes = {one["id"]: one for one in answer["nodes"]}
    waiting = [one["id"] for one in answer["nodes"] if one["parent"] is None][::-1]
    while waiting:
        one = nodes[waiting.pop()]
        name = "" if one["name"] is None else f" {one['name']} ({one['score']:.3f})"
        yield (
            f"{'  ' * len(one['path'])}{one['id']}{name}, {one['kind']}: {one['splats']} splats, {one['share']:.1%} "
            f"of the total weight, {sides_of(one['size'], answer['unit'])}, a mask of it in "
            f"{one['confidence']:.0%} of the views that see it"
        )
        waiting += one["parts"][::-1]
    for one in answer["relations"]:
        yield f"  {one['node']} is {one['relation']} {one['other']}: {one['gap']:.4g} {answer['unit']} apart"
    yield from (f"  {kind}: {path}" for kind, path in files.items())


def _vocabulary(options: argparse.Namespace, scene: Scene) -> tuple[TextEncoder | None, list[str]]:
    """The encoder and the words; none where objects get no names."""
    if options.vocabulary is None and not options.table and not options.encoder and scene.table is None:
        return None, []
    if options.vocabulary is not None and options.vocabulary.suffix == ".safetensors":
        encoder = scene.encoder(f"table:{options.vocabulary}")
        return encoder, scene.words(encoder)
    return encoder_and_words(options, scene, options.vocabulary, "--vocabulary")


def _lines(document: dict[str, Any]) -> Iterable[str]:
    yield document["explanation"]
    for one in document["objects"]:
        low, high = one["box"]
        name = "" if one["name"] is None else f" {one['name']} ({one['score']:.3f})"
        yield (
            f"  {one['id']}{name}: {one['splats']} splats, {one['share']:.1%} of the total weight, at "
            f"{place_of(one['centre'])}, from {place_of(low)} to {place_of(high)}, "
            f"{sides_of(one['size'], document['answer']['unit'])}, best in {', '.join(one['views'])}"
        )
    yield from (f"  {kind}: {path}" for kind, path in document["files"].items())
