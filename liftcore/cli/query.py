"""``splatlift query``: find the splats of a lifted scene that match words or examples."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli import options as common
from liftcore.cli.reply import check_outputs, lines_of, outputs_of, place_of, reply, write_files
from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore import Answer, Objects, Query, TextEncoder, ViewMask


LOCAL_SUFFIXES = (".splat", ".spz")  # of files whose positions are about the splats' origin
FIELD_OVERRIDES: dict[str, dict[str, Any]] = {  # keywords of options besides those of the fields
    "text": {
        "flag": "text", "nargs": "?", "action": "store", "default": None, "metavar": "text",
        "help": "the text to search for, in quotes",
    },
    "like": {"metavar": "EXAMPLE", "help": "VIEW:x,y, splat:J, object:N or a vector.npy"},
    "unlike": {"metavar": "EXAMPLE", "help": "a negative example, likewise"},
    "sets": {"metavar": "SET", "help": "object:N, as it is"},
    "negatives": {
        "flag": "--negative", "nargs": "+", "action": "extend", "metavar": "WORD",
        "help": "negative texts, up to the next option",
    },
    "threshold": {"help": "auto, paper or a number from -1 to 1"},
    "instances": {"help": "keep the best N objects"},
    "min_size": {"help": "leave out objects of fewer splats"},
    "keep": {"help": "of objects; default all"},
    "absent": {"help": "words of what is not there; default drop"},
    "top": {"default": 0, "help": "list the N best splats"},
}  # fmt: skip


def add_arguments(parser: common.Parser) -> None:
    """Add the options of the command."""
    from liftcore import Query

    parser.last = "text"
    common.add_lift(parser)
    common.add_encoder(parser)
    common.add_fields(parser, Query, (*Query.deciding(), "top"), FIELD_OVERRIDES)
    parser.add_argument("--objects", action="store_true", help="list the selected objects")
    common.add_world(parser)
    common.add_view(parser)
    parser.add_argument("--mask", type=Path, metavar="PNG", help="write the mask of the view")
    parser.add_argument("--attention", type=Path, metavar="PNG", help="write the attention map of the view")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="write the view with outlines, on --photo")
    parser.add_argument("--photo", type=Path, metavar="FILE", help="of the view; default: a render")
    parser.add_argument("--scores", type=Path, metavar="NPY", help="write the scores [P], float32")
    parser.add_argument("--object", type=Path, metavar="FILE", help="write the selected splats")
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats in colours of scores")


def run(options: argparse.Namespace) -> int:
    """Run the query, render the mask of a view, write the requested files, and print the answer."""
    from liftcore.files import read_image

    view = common.view_of(options, "mask", "attention", "overlay")
    files = outputs_of(options)
    query = _query(options)
    scene = common.open_lift(options)
    check_outputs(files, options, scene)
    hint = "or query by example, with --like"
    encoder = common.text_encoder(options, scene, hint, stand_in=True) if query.texts else None
    answer = scene.ask(query, encoder=encoder, places=options.top > 0)
    view_mask = None if view is None else scene.view_mask(answer, view)
    objects = scene.objects(answer) if options.objects else None
    document = _document(answer, objects, view_mask, encoder)
    photo = None
    if options.photo is not None and view_mask is not None:
        photo = read_image(options.photo, view_mask.mask.shape[::-1])[0]
    export = partial(scene.export, source=answer, view=view, view_mask=view_mask, photo=photo)
    document["files"] = write_files(files, {kind: partial(export, content=kind) for kind in files})
    if options.object is not None and options.object.suffix.lower() in LOCAL_SUFFIXES and any(scene.splats.origin):
        document["origin"] = scene.splats.origin
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _query(options: argparse.Namespace) -> Query:
    from liftcore import Query, read_example

    if options.text is None and not options.like and options.negatives:
        raise InvalidQuery(
            "text",
            expected="a text to search for, before --negative",
            got=f"only --negative {' '.join(options.negatives)}",
            hint="--negative takes all words up to the next option",
        )
    fields: dict[str, Any] = {name: getattr(options, name) for name in (*Query.deciding(), "top")}
    fields["text"] = [] if options.text is None else options.text
    fields |= {name: [read_example(example, f"--{name}") for example in fields[name]] for name in ("like", "unlike")}
    return Query(**fields)


def _document(
    answer: Answer, objects: Objects | None, view_mask: ViewMask | None, encoder: TextEncoder | None
) -> dict[str, Any]:
    """Return the answer as in HTTP, and the files and view of the command."""
    lists = {"top", "box"} if not answer.top else set()
    fields = answer.model_dump(mode="json", exclude=lists)
    fields |= {} if objects is None else objects.model_dump(mode="json")
    document = {"answer": fields, "encoder": encoder.name if encoder else None, "splats": len(answer.scores)}
    if view_mask is not None:
        share = float(view_mask.mask.mean())
        document["view"] = {"name": view_mask.view, "explanation": view_mask.explanation, "mask_share": share}
    return document


def _lines(document: dict[str, Any]) -> Iterable[str]:
    answer = document["answer"]
    threshold, query_text = answer["threshold"], ", ".join(map(repr, [*answer["text"], *answer["like"]]))
    for entry in answer["wording"]:
        relation = "excludes" if entry["match"] == "negation" else "is queried as"
        yield f"{entry['text']!r} {relation} {entry['word']!r}"
    if answer["present"] is not None or document["encoder"]:
        yield answer["reason"]
    if threshold["value"] is not None:
        selection = f"{answer['count']} of {document['splats']} splats at or above {threshold['value']:.4g}"
        yield f"{query_text}: {selection} ({threshold['explanation']})"
    else:
        no_selection = "nothing is selected; --absent keep selects the most similar splats"
        yield f"{query_text}: {no_selection if answer['present'] is False else threshold['explanation']}"
    if rivals := answer["rivals"]:
        yield f"  words nearer to it: {', '.join(map(repr, rivals))}"
    if "view" in document:
        view = document["view"]
        yield f"  view {view['name']}: {view['mask_share']:.2%} of the image ({view['explanation']})"
    for candidate in answer["candidates"]:
        whole_object = "the example" if answer["like"] else "the object"
        size = f"{candidate['splats']} splats, {candidate['share']:.0%} of {whole_object}"
        yield f"  may be {candidate['set']}, {candidate['kind']}: {size}"
    for best in answer.get("top", []):
        yield f"  splat {best['splat']}: score {best['score']:.4g} at {place_of(best['position'])}"
    if count := answer.get("unassigned_splats"):
        yield f"  {count} selected splats are in no object: single splats or small groups"
    yield from lines_of(document)
    if "origin" in document:
        yield f"  positions in the file are relative to the origin {place_of(document['origin'])}"
