"""``splatlift segment``: to every splat the best of many words, or none; and the best words for an example."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_encoder, add_lift, add_view, count, opened_lift, text_encoder, view_of
from liftcore.cli.query import made_from
from liftcore.cli.reply import free_outputs, place_of, reply, write_files
from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore import Scene, TextEncoder

OUTPUTS = ("labels", "picture", "coloured", "splat_labels", "labelled")  # options that name a file to write


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_lift(parser)
    parser.add_argument("--words", type=Path, metavar="FILE", help="the words, one a line; else all of the table's")
    add_encoder(parser)
    what = "what is this? an example as 'query --like' takes it; may be given several times"
    parser.add_argument("--what", action="append", default=[], metavar="EXAMPLE", help=what)
    parser.add_argument("--top", type=count, default=5, metavar="N", help="words for each --what; 5")
    add_view(parser)
    parser.add_argument("--labels", type=Path, metavar="PNG", help="write the words of the view's pixels, as numbers")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="write the view in their colours, with a legend")
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats in the colours of their words")
    parser.add_argument("--splat-labels", type=Path, metavar="NPY", help="write the numbers [P] of the splats' words")
    labelled = "write all splats with class_id, instance_id, score and confidence, and names and boxes to PLY.json"
    parser.add_argument("--labelled", type=Path, metavar="PLY", help=labelled)


def run(options: argparse.Namespace) -> int:
    """Name the splats, write what was asked for, and say which words are there; or name the examples alone."""
    view = view_of(options, "labels", "picture")
    files = {kind: path for kind in OUTPUTS if (path := getattr(options, kind)) is not None}
    if options.labelled is not None:
        files["names"] = options.labelled.with_name(f"{options.labelled.name}.json")
    given = [path for path in (options.lift, options.table, options.words, options.camera) if path]
    free_outputs(files, given)
    from liftcore import read_example
    from liftcore.models import BestWords

    scene = opened_lift(options)
    if files:
        free_outputs(files, made_from(scene))
    encoder, words = encoder_and_words(options, scene, options.words)
    document: dict[str, Any] = {"encoder": encoder.name, "words": len(words)}
    if options.what:
        named = [(notation, read_example(notation, "--what")) for notation in options.what]
        best = {said: scene.what(example, words, top=options.top, encoder=encoder) for said, example in named}
        document["examples"] = [
            BestWords(example=said, words=nearest).model_dump(mode="json") for said, nearest in best.items()
        ]
        document["what"] = {said: [vars(word) for word in nearest] for said, nearest in best.items()}  # for a release
    if files or not options.what:
        found = scene.segment(words, encoder=encoder, progress=True)
        document["answer"] = found.summary.model_dump(mode="json")
        # The keys of before, which go with the next release.
        document |= vars(found.summary) | {"found": [vars(named) for named in found.found]}
        exports = {kind: partial(scene.export, source=found, what=kind, view=view) for kind in files}
        document["files"] = write_files(files, exports)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def encoder_and_words(
    options: argparse.Namespace, scene: Scene, path: Path | None, option: str = "--words"
) -> tuple[TextEncoder, list[str]]:
    """The text encoder that the options name, and the words of a file, one a line, or all that its table has.

    The file comes first: an encoder takes seconds to open, or is not here.
    """
    words = None
    if path is not None:
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidQuery(option, expected="a file of words, one a line", got=str(error)[:120]) from None
        words = list(dict.fromkeys(line.strip() for line in lines if line.strip()))
    encoder = text_encoder(options, scene)
    return encoder, scene.words(encoder) if words is None else words


def _lines(document: dict[str, Any]) -> Iterable[str]:
    for example, words in document.get("what", {}).items():
        best = ", ".join(f"{word['word']} {word['score']:.3f}" for word in words)
        yield f"{example}: {best}"
    if "found" not in document:
        return
    bare = f"{document['none']} of {document['splats']} splats have none"
    yield f"{len(document['found'])} of {document['words']} words are there; {bare}"
    for named in document["found"]:
        low, high = named["box"]
        yield (
            f"  {named['value']} {named['word']}: {named['splats']} splats, {named['share']:.1%} of the "
            f"total weight, score {named['score']:.3f}, margin {named['margin']:.3f}, "
            f"from {place_of(low)} to {place_of(high)}"
        )
    yield from (f"  {kind.replace('_', ' ')}: {path}" for kind, path in document["files"].items())
