"""``splatlift segment``: label every splat with the best of many words, or list the best words for an example."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import (
    Parser,
    add_encoder,
    add_lift,
    add_view,
    count,
    open_lift,
    text_encoder,
    view_of,
)
from liftcore.cli.reply import check_outputs, lines_of, reply, write_files
from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore import Scene, TextEncoder

OUTPUTS = ("labels", "picture", "coloured", "splat_labels", "labelled")  # options that name a file to write


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    add_lift(parser)
    parser.add_argument(
        "--words", type=Path, metavar="FILE", help="the words, one a line; default: all words of the table"
    )
    add_encoder(parser)
    example_help = "list the best words for an example, as for 'query --like'; may be repeated"
    parser.add_argument("--example", action="append", default=[], metavar="EXAMPLE", help=example_help)
    parser.add_argument("--top", type=count, default=5, metavar="N", help="words for each --example; default 5")
    add_view(parser)
    parser.add_argument(
        "--labels", type=Path, metavar="PNG", help="write the numbers of the words of the view's pixels"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="write the view in the words' colours, with a legend"
    )
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats in the colours of their words")
    parser.add_argument("--splat-labels", type=Path, metavar="NPY", help="write the numbers [P] of the splats' words")
    labelled_help = (
        "write all splats with class_id, instance_id, score and confidence, and names and boxes to PLY.json"
    )
    parser.add_argument("--labelled", type=Path, metavar="PLY", help=labelled_help)


def run(options: argparse.Namespace) -> int:
    """Label the splats, write the requested files, and list the words; or list only the words of examples."""
    view = view_of(options, "labels", "picture")
    files = {kind: path for kind in OUTPUTS if (path := getattr(options, kind)) is not None}
    if options.labelled is not None:
        files["names"] = options.labelled.with_name(f"{options.labelled.name}.json")
    from liftcore import read_example
    from liftcore.models import BestWords

    scene = open_lift(options)
    check_outputs(files, options, scene)
    encoder, words = encoder_and_words(options, scene, options.words)
    document: dict[str, Any] = {"encoder": encoder.name, "words": len(words)}
    if options.example:
        examples = [(notation, read_example(notation, "--example")) for notation in options.example]
        best = {
            text: scene.nearest_words(example, words, top=options.top, encoder=encoder) for text, example in examples
        }
        document["examples"] = [
            BestWords(example=text, words=nearest).model_dump(mode="json") for text, nearest in best.items()
        ]
    if files or not options.example:
        segmentation = scene.segment(words, encoder=encoder, progress=True)
        document["answer"] = segmentation.summary.model_dump(mode="json")
        exports = {kind: partial(scene.export, source=segmentation, what=kind, view=view) for kind in files}
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
    encoder = text_encoder(options, scene)
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
