"""``splatlift query``: where in a lifted scene is what the words say, or what is like this example?"""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import (
    Parser,
    add_encoder,
    add_fields,
    add_lift,
    add_view,
    add_world,
    opened_lift,
    sides_of,
    text_encoder,
    view_of,
)
from liftcore.cli.reply import free_outputs, place_of, reply, write_files
from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from collections.abc import Iterable

    from PIL.Image import Image

    from liftcore import Answer, Objects, Query, Scene, TextEncoder, ViewMask


LOCAL_SUFFIXES = (".splat", ".spz")  # of files whose positions are about the splats' origin
OWN: dict[str, dict[str, Any]] = {  # what the command line says of fields beside what they say themselves
    "text": {
        "flag": "text", "nargs": "?", "action": "store", "default": None, "metavar": "text",
        "help": "what to look for, in quotes; may be left out beside --like",
    },
    "like": {"metavar": "EXAMPLE|FILE.npy"},
    "unlike": {"metavar": "EXAMPLE|FILE.npy"},
    "negatives": {
        "flag": "--negative", "nargs": "+", "action": "extend", "metavar": "WORD",
        "help": "texts to compete with: all up to the next option, so TEXT goes before it; may be given again",
    },
    "top": {"default": 0},
}  # fmt: skip
OUTPUTS = ("object", "coloured", "scores", "mask", "attention", "overlay")  # options that name a file to write


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    from liftcore import Query

    parser.last = "text"
    add_lift(parser)
    add_encoder(parser)
    add_fields(parser, Query, (*Query.deciding(), "top"), OWN)
    parser.add_argument("--objects", action="store_true", help="name the things found, with their places and boxes")
    add_world(parser)
    add_view(parser)
    parser.add_argument("--mask", type=Path, metavar="PNG", help="write the mask of the view")
    parser.add_argument("--attention", type=Path, metavar="PNG", help="write the attention map of the view")
    shows = "write the view with what was found outlined, and a caption"
    parser.add_argument("--overlay", type=Path, metavar="PNG", help=shows)
    parser.add_argument("--photo", type=Path, metavar="FILE", help="of the view, for --overlay; else a render")
    parser.add_argument("--scores", type=Path, metavar="NPY", help="write the scores [P], float32")
    only = "write the splats that were found, and no others: .ply with all their properties, .splat or .spz"
    parser.add_argument("--object", type=Path, metavar="FILE", help=only)
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats, coloured by their scores")


def run(options: argparse.Namespace) -> int:
    """Ask, look where a view is named, write what was asked for, and say what was found."""
    view = view_of(options, "mask", "attention", "overlay")
    files = {kind: path for kind in OUTPUTS if (path := getattr(options, kind)) is not None}
    free_outputs(files, [path for path in (options.lift, options.table, options.camera) if path])
    query = _query(options)
    scene = opened_lift(options)
    if files:
        free_outputs(files, made_from(scene))
    hint = "or ask by example, with --like"
    encoder = text_encoder(options, scene, hint, stand_in=True) if query.texts else None
    answer = scene.ask(query, encoder=encoder, places=options.top > 0)
    seen = None if view is None else scene.look(answer, view)
    found = scene.objects(answer) if options.objects else None
    document = _document(answer, found, seen, encoder)
    photo = None if seen is None else _picture(options.photo, seen.mask.shape[::-1])
    export = partial(scene.export, source=answer, view=view, seen=seen, photo=photo)
    document["files"] = write_files(files, {kind: partial(export, what=kind) for kind in files})
    if options.object is not None and options.object.suffix.lower() in LOCAL_SUFFIXES and any(scene.splats.origin):
        document["origin"] = scene.splats.origin
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _query(options: argparse.Namespace) -> Query:
    from liftcore import Query, read_example

    if options.text is None and not options.like and options.negatives:
        raise InvalidQuery(
            "text",
            expected="what to look for, before --negative",
            got=f"--negative {' '.join(options.negatives)} alone",
            hint="--negative takes all words up to the next option",
        )
    fields: dict[str, Any] = {name: getattr(options, name) for name in (*Query.deciding(), "top")}
    fields["text"] = [] if options.text is None else options.text
    fields |= {name: [read_example(one, f"--{name}") for one in fields[name]] for name in ("like", "unlike")}
    return Query(**fields)


def _document(
    answer: Answer, found: Objects | None, seen: ViewMask | None, encoder: TextEncoder | None
) -> dict[str, Any]:
    """The answer as HTTP has it, and what the command did; the keys of before go with the next release."""
    lists = {"top", "box"} if not answer.top else set()
    told = answer.model_dump(mode="json", exclude=lists)
    told |= {} if found is None else found.model_dump(mode="json")
    document = {"answer": told, "encoder": encoder.name if encoder else None, "splats": len(answer.scores)}
    document |= _keys_of_before(answer, found)
    if seen is not None:
        share = float(seen.mask.mean())
        document["view"] = {"name": seen.view, "explanation": seen.explanation, "mask_share": share}
    return document


def _keys_of_before(answer: Answer, found: Objects | None) -> dict[str, Any]:
    positives = len(answer.query.positives)
    document: dict[str, Any] = {
        "query": [str(term) for term in answer.query.positives],
        "negatives": [str(term) for term in answer.query.terms[positives:]],
        "selected": answer.count,
        "threshold": answer.threshold.value,
        "threshold_method": answer.threshold.method,
        "explanation": answer.threshold.explanation,
        **{name: getattr(answer, name) for name in ("clear", "present", "presence", "why", "statistics")},
    }
    if answer.top:
        document |= {"top": [vars(splat) for splat in answer.top], "box": answer.box}
    if found is not None:
        document |= {"objects": [vars(thing) for thing in found.objects], "strays": found.strays}
    return document


def _picture(photo: Path | None, size: tuple[int, int]) -> Image | None:
    from liftcore.files import read_image

    return None if photo is None else read_image(photo, size)[0]


def made_from(scene: Scene) -> list[Path]:
    """The files that a lift remembers."""
    return [Path(file.path) for file in (scene.metadata.splats, scene.metadata.cameras, *scene.metadata.features)]


def _lines(document: dict[str, Any]) -> Iterable[str]:
    asked = ", ".join(map(repr, document["query"]))
    yield from (f"{one['text']!r} is asked as {one['word']!r}" for one in document["answer"]["wording"])
    if document["present"] is not None or document["encoder"]:
        yield document["why"]
    if document["threshold"] < math.inf:
        found = f"{document['selected']} of {document['splats']} splats at or above {document['threshold']:.4g}"
        yield f"{asked}: {found} ({document['explanation']})"
    else:
        kept = "nothing is selected; --absent keep selects what is most like it"
        yield f"{asked}: {kept if document['present'] is False else document['explanation']}"
    if rivals := document["answer"]["rivals"]:
        yield f"  nearer to it: {', '.join(map(repr, rivals))}"
    if "view" in document:
        view = document["view"]
        yield f"  view {view['name']}: {view['mask_share']:.2%} of the image ({view['explanation']})"
    for one in document["answer"]["candidates"]:
        of = "what is shown there" if document["answer"]["like"] else "the thing"
        shown = f"{one['splats']} splats, {one['share']:.0%} of {of}"
        yield f"  may be {one['set']}, {one['kind']}: {shown}"
    for best in document.get("top", []):
        yield f"  splat {best['splat']}: score {best['score']:.4g} at {place_of(best['position'])}"
    for number, thing in enumerate(document.get("objects", []), 1):
        low, high = thing["box"]
        yield (
            f"  object {number}: {thing['splats']} splats, {thing['share']:.1%} of what is selected, score "
            f"{thing['score']:.4g}, at {place_of(thing['centre'])}, from {place_of(low)} to {place_of(high)}, "
            f"{sides_of(thing['size'], document['answer']['unit'])}"
        )
    if document.get("strays"):
        yield f"  {document['strays']} splats are strays: single or in specks, and of no object"
    yield from (f"  {kind}: {path}" for kind, path in document["files"].items())
    if "origin" in document:
        yield f"  positions in its format are less the origin of map coordinates, {place_of(document['origin'])}"
