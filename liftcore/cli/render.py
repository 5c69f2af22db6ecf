"""``splatlift render``: render a lifted scene from any camera: colours, features, clusters or confidence."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from liftcore.cli.options import Parser, add_fields, add_lift, add_view, open_lift, view_of
from liftcore.cli.reply import check_outputs, reply, write_files
from liftcore.errors import InvalidQuery


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    from liftcore import Picture

    add_lift(parser)
    add_view(parser)
    add_fields(parser, Picture, ["channel"], {})
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG", help="the picture to write")


def run(options: argparse.Namespace) -> int:
    """Render the picture, and print its path."""
    view, files = view_of(options), {"output": options.output}
    if view is None:
        raise InvalidQuery("--view", expected="a view to render", got="no --view and no --camera")
    scene = open_lift(options)
    check_outputs(files, options, scene)
    paths = write_files(files, {"output": partial(scene.export, what=options.channel, view=view)})
    document = {"channel": options.channel, "out": paths["output"]}
    reply(document, as_json=options.json, lines=[paths["output"]])
    return 0
