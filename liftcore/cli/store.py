"""``splatlift store``: the data directory of the HTTP service, in a process of the service's own."""

import argparse
from pathlib import Path

from liftcore.cli.options import Parser
from liftcore.cli.serve import become


def add_arguments(parser: Parser, shared: Parser) -> None:
    """The options of the command, which ``python -m service.store`` takes too."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    rebuild = actions.add_parser("rebuild", parents=[shared], help="rows for files that the database does not know")
    backup = actions.add_parser("backup", parents=[shared], help="copy a data directory, beside a server that runs")
    backup.add_argument("directory", type=Path, metavar="DIR", help="the backup, which is not there yet")
    restore = actions.add_parser("restore", parents=[shared], help="make a data directory of a backup")
    restore.add_argument("directory", type=Path, metavar="DIR", help="the backup")
    verify = actions.add_parser("verify", parents=[shared], help="compare every file with its digest")
    for action in (rebuild, backup, restore, verify):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Become ``python -m service.store``."""
    directory = [str(options.directory)] if "directory" in options else []
    arguments = [options.action, *directory, *([] if options.data is None else [f"--data={options.data}"])]
    become("service.store", arguments + (["--json"] if options.json else []))
