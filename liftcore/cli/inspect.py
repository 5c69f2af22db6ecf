"""``splatlift inspect``: what is in this file, and what is wrong with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.cli.reply import reply

if TYPE_CHECKING:
    import argparse


def run(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.io.inspect import inspect_file

    reply({"file": str(options.file), **inspect_file(options.file)}, as_json=options.json)
    return 0
