"""``splatlift inspect``: describe a file and its problems."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("file", type=Path, help="splats, cameras, features, a lift, masks or a text table")


def run(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.evaluate import inspect_file

    document = {"file": str(options.file), **inspect_file(options.file)}
    unnamed = {name: "not named" for name in ("encoder", "text_space") if document.get(name) == ""}
    reply(document if options.json else document | unnamed, as_json=options.json)
    return 0
