"""``splatlift inspect``: what is in this file, and what is wrong with it."""

from __future__ import annotations

import argparse

from liftcore.cli.options import Parser, place
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("file", type=place, help="splats, cameras, features, a lift, masks or a text table")


def run(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.evaluate import inspect_file

    document = {"file": str(options.file), **inspect_file(options.file)}
    unnamed = {name: "not named" for name in ("encoder", "text_space") if document.get(name) == ""}
    reply(document if options.json else document | unnamed, as_json=options.json)
    return 0
