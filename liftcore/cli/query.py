"""``splatlift query``: where in a lifted scene is what the words say, or what is like this example?"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import THRESHOLDS, Parser, add_negative, count, encoder_spec
from liftcore.cli.reply import free_output, reply, writing
from liftcore.errors import InvalidQuery
from liftcore.io.files import whole_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from liftcore.query.ask import Answer
    from liftcore.query.render import ViewMask
    from liftcore.query.scene import QueryScene
    from liftcore.query.terms import Example, Query
    from liftcore.query.text import TextEncoder


OUTPUTS = ("object", "coloured", "scores", "mask", "attention")  # options that name a file to write


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.last = "text"
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("text", nargs="?", help="what to look for, in quotes; may be left out beside --like")
    like = "VIEW:x,y (a pixel), region:VIEW:LEVEL:ID, splat:J or a vector FILE.npy; may be given several times"
    parser.add_argument("--like", action="append", default=[], metavar="EXAMPLE", help=f"more of this: {like}")
    parser.add_argument("--unlike", action="append", default=[], metavar="EXAMPLE", help="less of that, likewise")
    words = parser.add_mutually_exclusive_group()
    words.add_argument("--table", type=Path, metavar="FILE", help="precomputed text embeddings")
    words.add_argument(
        "--encoder", metavar="NAME", help="minilm, open_clip:MODEL/TAG, open_clip:MODEL@FILE or table:FILE"
    )
    add_negative(parser, ", so TEXT goes before it")
    parser.add_argument("--threshold", default="auto", metavar="T", help=THRESHOLDS)
    parser.add_argument("--instances", type=count, metavar="N", help="how many there are, if you know")
    keep = "of what was found, all or the largest alone: in the mask, in --object and in --objects"
    parser.add_argument("--keep", choices=("all", "largest"), default="all", help=keep)
    parser.add_argument("--top", type=count, default=0, metavar="N", help="name the best N splats")
    parser.add_argument("--objects", action="store_true", help="name the things found, with their places and boxes")
    parser.add_argument("--view", metavar="NAME", help="the camera to see the answer from")
    parser.add_argument("--mask", type=Path, metavar="PNG", help="write the mask of the view")
    parser.add_argument("--attention", type=Path, metavar="PNG", help="write the attention map of the view")
    parser.add_argument("--scores", type=Path, metavar="NPY", help="write the scores [P], float32")
    parser.add_argument("--object", type=Path, metavar="PLY", help="write the splats that were found, and no others")
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats, coloured by their scores")


def run(options: argparse.Namespace) -> int:
    """Ask, look where a view is named, write what was asked for, and say what was found."""
    if (options.mask or options.attention) and not options.view:
        raise InvalidQuery("--mask and --attention", expected="a view to see them from", got="no --view")
    outputs = [path.absolute() for kind in OUTPUTS if (path := getattr(options, kind)) is not None]
    if len(set(outputs)) < len(outputs):
        raise InvalidQuery(f"--{', --'.join(OUTPUTS)}", expected="a file each", got="the same file twice")
    for path in outputs:
        free_output(path, [options.lift, *([options.table] if options.table else [])])
    from liftcore.query.ask import ask, top
    from liftcore.query.objects import objects
    from liftcore.query.scene import QueryScene

    query = _query(options)
    scene = QueryScene.open(options.lift)
    for path in outputs:
        made_from = (scene.metadata.splats, scene.metadata.cameras, *scene.metadata.features)
        free_output(path, [Path(file.path) for file in made_from])
    encoder = _encoder(options, scene) if query.texts else None
    answer = ask(scene, query, encoder)
    seen = _view_mask(scene, answer, options.view) if options.view else None
    document = _document(answer, seen, encoder)
    if options.top:
        best = top(answer, scene, options.top)
        document |= {"top": [asdict(splat) for splat in best.best], "box": best.box}
    if options.objects:
        found = objects(scene, answer)
        document |= {"objects": [asdict(thing) for thing in found.found], "strays": found.strays}
    document["files"] = _write(options, scene, answer, seen)
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _query(options: argparse.Namespace) -> Query:
    from liftcore.query.terms import Query

    if options.text is None and not options.like and options.negative:
        raise InvalidQuery(
            "text",
            expected="what to look for, before --negative",
            got=f"--negative {' '.join(options.negative)} alone",
            hint="--negative takes all words up to the next option",
        )
    return Query(
        positives=(*([options.text] if options.text is not None else []), *_examples(options.like, "--like")),
        negatives=(*options.negative, *_examples(options.unlike, "--unlike")),
        threshold=_threshold(options.threshold),
        instances=options.instances,
        keep=options.keep,
    )


def _examples(notations: list[str], argument: str) -> list[Example]:
    from liftcore.query.terms import parse_example, read_vector

    return [
        read_vector(Path(notation)) if notation.endswith(".npy") else parse_example(notation, argument)
        for notation in notations
    ]


def _encoder(options: argparse.Namespace, scene: QueryScene) -> TextEncoder:
    from liftcore.query.text import open_encoder

    return open_encoder(
        encoder_spec(
            options, "" if options.table else scene.metadata.text_space, hint="or ask by example, with --like"
        )
    )


def _view_mask(scene: QueryScene, answer: Answer, view: str) -> ViewMask:
    from liftcore.query.render import view_mask  # with torch, which numbers do without

    return view_mask(scene, answer, view)


def _threshold(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _document(answer: Answer, seen: ViewMask | None, encoder: TextEncoder | None) -> dict[str, Any]:
    document: dict[str, Any] = {
        "query": [str(term) for term in answer.query.positives],
        "negatives": [str(term) for term in answer.query.negatives],
        "encoder": encoder.name if encoder else None,
        "splats": len(answer.scores),
        "selected": answer.count,
        "threshold": answer.threshold,
        "threshold_method": answer.threshold_method,
        "explanation": answer.explanation,
        "statistics": dict(answer.statistics),
    }
    if seen is not None:
        document["view"] = {
            "name": seen.view,
            "explanation": seen.explanation,
            "mask_share": float(seen.mask.mean()),
        }
    return document


def _write(options: argparse.Namespace, scene: QueryScene, answer: Answer, seen: ViewMask | None) -> dict[str, str]:
    """Write what was asked for, the object first: when nothing was found, nothing is written."""
    from liftcore.query.export import coloured_ply, object_ply, scores_npy

    blocks: dict[str, Callable[[], Iterable[bytes]]] = {
        "object": lambda: object_ply(scene, answer),
        "coloured": lambda: coloured_ply(scene, answer),
        "scores": lambda: [scores_npy(answer)],
    }
    if seen is not None:
        from liftcore.query.render import attention_png, mask_png

        blocks |= {"mask": lambda: [mask_png(seen)], "attention": lambda: [attention_png(seen)]}
    files = {kind: path for kind in OUTPUTS if (path := getattr(options, kind)) is not None}
    for kind, path in files.items():
        with writing(path):
            content = blocks[kind]()  # before there is a draft, or a folder for it: nothing found is no file
            with whole_file(path) as handle:
                handle.writelines(content)
    return {kind: str(path) for kind, path in files.items()}


def _lines(document: dict[str, Any]) -> Iterable[str]:
    yield (
        f"{', '.join(map(repr, document['query']))}: {document['selected']} of {document['splats']} splats "
        f"at or above {document['threshold']:.4g} ({document['explanation']})"
    )
    if "view" in document:
        view = document["view"]
        yield f"  view {view['name']}: {view['mask_share']:.2%} of the image ({view['explanation']})"
    for best in document.get("top", []):
        yield f"  splat {best['splat']}: score {best['score']:.4g} at {_place(best['position'])}"
    for number, thing in enumerate(document.get("objects", []), 1):
        low, high = thing["box"]
        yield (
            f"  object {number}: {thing['splats']} splats, {thing['share']:.1%} of the evidence, score "
            f"{thing['score']:.4g}, at {_place(thing['centre'])}, from {_place(low)} to {_place(high)}"
        )
    if document.get("strays"):
        yield f"  {document['strays']} splats are strays: single or in specks, and of no object"
    yield from (f"  {kind}: {path}" for kind, path in document["files"].items())


def _place(point: tuple[float, ...]) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"
