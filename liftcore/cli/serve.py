"""``splatlift serve``: the HTTP service, in place of this process."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from liftcore.cli.options import Parser


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("--host", help="the address to bind")
    parser.add_argument("--port", type=int, help="the port to bind; 0 picks a free one")
    parser.add_argument("--data", type=Path, metavar="DIR", help="for the database and all files")
    parser.add_argument("--encoder", metavar="NAME", help="the default text encoder")
    parser.epilog = (
        "All settings can be environment variables: python -m service --help lists them, with their defaults."
    )
    anew = "where the database is gone or older than the files, begin an empty one; the files go to quarantine"
    parser.add_argument("--new", action="store_true", help=anew)


def run(options: argparse.Namespace) -> int:
    """Become the service."""
    given = {name: getattr(options, name) for name in ("host", "port", "data", "encoder")}
    arguments = [part for name, value in given.items() if value is not None for part in (f"--{name}", str(value))]
    arguments += [f"--{name}" for name in ("new", "json") if getattr(options, name)]
    become("service", arguments)


def become(program: str, arguments: Sequence[str]) -> NoReturn:
    """Go on as ``python -m PROGRAM``.

    Raises:
        Unavailable: the service is not installed.
    """
    from liftcore.query.page import require_service

    require_service()
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", program, *arguments])
