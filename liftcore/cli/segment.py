"""``splatlift segment`` and ``objects``: label splats with words, and list the objects of a lift with their names."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli import options as common
from liftcore.cli.reply import check_outputs, lines_of, outputs_of, reply, write_files
from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore import Scene, TextEncoder
    from liftcore.models import SceneTree


def add_arguments(parser: common.Parser) -> None:
    """Add the options of the command."""
    common.add_lift(parser)
    parser.add_argument("--words", type=Path, metavar="FILE", help="one a line; default: all of the table")
    common.add_encoder(parser)
    examples = "list the best words for an example of 'query --like'"
    parser.add_argument("--example", action="append", default=[], metavar="EXAMPLE", help=examples)
    parser.add_argument("--top", type=common.count, default=5, metavar="N", help="words for an example; default 5")
    common.add_view(parser)
    parser.add_argument("--map", type=Path, metavar="PNG", help="write numbers of the view's words")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="write the view with a legend")
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write splats in colours of words")
    parser.add_argument("--labels", type=Path, metavar="NPY", help="write the splats' numbers [P]")
    parser.add_argument("--labelled", type=Path, metavar="PLY", help="write labelled splats, and PLY.json")


def run(options: argparse.Namespace) -> int:
    """Label the splats, write the requested files, and list the words; or list only the words of examples."""
    view = common.view_of(options, "map", "picture")
    files = outputs_of(options)
    if options.labelled is not None:
        files["names"] = options.labelled.with_name(f"{options.labelled.name}.json")
    from liftcore import read_example
    from liftcore.models import BestWords

    scene = common.open_lift(options)
    check_outputs(files, options, scene)
    encoder, words = encoder_and_words(options, scene, options.words)
    document: dict[str, Any] = {"encoder": encoder.name, "words": len(words)}
    if options.example:
        examples = {text: read_example(text, "--example") for text in options.example}
        document["examples"] = [
            BestWords(
                example=text, words=scene.nearest_words(example, words, top=options.top, encoder=encoder)
            ).model_dump(mode="json")
            for text, example in examples.items()
        ]
    if files or not options.example:
        segmentation = scene.segment(words, encoder=encoder, progress=True)
        document["answer"] = segmentation.summary.model_dump(mode="json")
        exports = {kind: partial(scene.export, source=segmentation, content=kind, view=view) for kind in files}
        document["files"] = write_files(files, exports)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def encoder_and_words(
    options: argparse.Namespace, scene: Scene, path: Path | None, option: str = "--words"
) -> tuple[TextEncoder, list[str]]:
    """Open the text encoder of the options, and read the words of a file, one a line, or all words of its table.

    The file is read first, as an encoder takes seconds to open, or is not available.
    """
    words = None
    if path is not None:
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidQuery(option, expected="a file of words, one a line", got=str(error)[:120]) from None
        words = list(dict.fromkeys(line.strip() for line in lines if line.strip()))
    encoder = common.text_encoder(options, scene)
    return encoder, scene.words(encoder) if words is None else words


def _lines(document: dict[str, Any]) -> Iterable[str]:
    for example in document.get("examples", ()):
        best = ", ".join(f"{word['word']} {word['score']:.3f}" for word in example["words"])
        yield f"{example['example']}: {best}"
    if "answer" not in document:
        return
    answer = document["answer"]
    unlabelled = f"{answer['none']} of {answer['splats']} splats have no word"
    yield f"{len(answer['named_words'])} of {document['words']} words found; {unlabelled}"
    yield from lines_of(document)


def add_arguments_objects(parser: common.Parser) -> None:
    """Add the options of the command ``objects``."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="names: words, or a text table")
    common.add_encoder(parser)
    parser.add_argument("--tree", action="store_true", help="list parts and groups too")
    common.add_world(parser)
    parser.add_argument("--csv", type=Path, metavar="CSV", help="write the objects as a table")
    parser.add_argument("--into", type=Path, metavar="FOLDER", help="write a PLY of each object")
    common.add_splats(parser)


def run_objects(options: argparse.Namespace) -> int:
    """List the objects, or all nodes of the tree, and write the requested files."""
    files = outputs_of(options)
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, world=common.world_of(options))
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
