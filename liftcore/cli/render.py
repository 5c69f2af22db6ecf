"""``splatlift render``: a lifted scene from any camera, in its colours, features, clusters or confidence."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from liftcore.cli.options import Parser, add_fields, add_lift, add_view, opened_lift, view_of
from liftcore.cli.query import made_from
from liftcore.cli.reply import free_outputs, reply, write_files
from liftcore.errors import InvalidQuery


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    from liftcore import Picture

    add_lift(parser)
    add_view(parser)
    add_fields(parser, Picture, ["what"], {})
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG", help="the picture to write")


def run(options: argparse.Namespace) -> int:
    """Draw it, and say what was written."""
    view, files = view_of(options), {"output": options.output}
    if view is None:
        raise InvalidQuery("--view", expected="a view to see it from", got="no --view and no --camera")
    free_outputs(files, [path for path in (options.lift, options.camera) if path])
    scene = opened_lift(options)
    free_outputs(files, made_from(scene))
    written = write_files(files, {"output": partial(scene.export, what=options.what, view=view)})
    reply({"what": options.what, "out": written["output"]}, as_json=options.json, lines=[written["output"]])
    return 0
