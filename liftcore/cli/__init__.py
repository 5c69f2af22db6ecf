"""Public: ``splatlift``, the command line.

Each command is a file, here or in the service's package: ``add_arguments`` and ``run``.

Exit status: 0; 2 for input that is the user's to mend, with one line on stderr that says what; 1 for our own
fault. With ``--json`` stdout holds one JSON object and nothing else.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import Any

from liftcore import __version__, load_plugin
from liftcore.cli.options import BAD_INPUT, Elsewhere, Parser, misplaced, place, shared_options, whole
from liftcore.errors import SplatliftError
from liftcore.files import local_path

__all__ = ["Parser", "build_parser", "main", "place", "whole"]  # what commands of other packages are made of
COMMANDS = {
    "check": "do splats, cameras, photos and features belong together",
    "lift": "lift features onto splats",
    "refine": "a finished lift with smooth features",
    "transfer": "a finished lift on an edited copy of its splats",
    "plan": "what a lift would do and need",
    "query": "find words and examples in a lift",
    "segment": "name every splat of a lift by the best of many words",
    "objects": "the things in a lift, found without a word",
    "export": "a lifted scene with its labels, for other programs",
    "render": "a picture of a lift from any camera",
    "pack": "make a feature pack of the field's formats",
    "encode": "make a feature pack of images",
    "inspect": "what is in a file, and what is wrong",
    "evaluate": "lifts against the field's labels",
    "bench": "how fast this machine lifts",
    "tradeoff": "speed against accuracy on your scene",
}
SERVICE_COMMANDS = {  # files of another package, which are entry points in splatlift.commands
    "demo": "the whole job, through the real service",
    "serve": "run the HTTP service",
    "view": "one lift on the service's page, until Ctrl-C",
    "keys": "who may use the HTTP service",
    "store": "mend the HTTP service's data directory",
}
WITH_ACTIONS = ("keys", "pack", "store")  # whose actions take the shared options
OUR_FAULT = 1
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    try:
        options = build_parser().parse_args(argv)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    try:
        bring(options)
        status = _module(options.command).run(options)
        sys.stdout.flush()
        return status
    except SplatliftError as error:
        print(f"splatlift: {misplaced(options) or error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("splatlift: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the answer has seen enough; what is still buffered goes nowhere, without a complaint.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OUR_FAULT
    except Exception as error:
        if options.debug:
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())[:400]
        print(f"splatlift: our fault: {what} (--debug shows where)", file=sys.stderr)
        return OUR_FAULT


def bring(options: argparse.Namespace) -> None:
    """Put paths of this machine in the place of inputs that lie elsewhere, whose options ``elsewhere`` names."""
    options.elsewhere = [name for name, value in vars(options).items() if isinstance(value, Elsewhere)]
    for name, value in vars(options).items():
        if name == "output":
            continue
        if isinstance(value, Elsewhere):
            setattr(options, name, local_path(value))
        elif isinstance(value, list):
            setattr(options, name, [local_path(one) if isinstance(one, Elsewhere) else one for one in value])


def build_parser() -> argparse.ArgumentParser:
    """All commands; one's options are added when it is parsed, and what it needs is loaded when it runs."""
    parser = Parser(prog="splatlift", description="Lift 2D features onto trained splats and query them in words.")
    parser.add_argument("--version", action="version", version=f"splatlift {__version__}")
    shared = shared_options()
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, said in (SERVICE_COMMANDS | COMMANDS).items():
        own = commands.add_parser(name, parents=[] if name in WITH_ACTIONS else [shared], help=said)
        own.fill = partial(_add_options, name, own, [shared] if name in WITH_ACTIONS else [])
    return parser


def _add_options(name: str, parser: Parser, shared: list[Parser]) -> None:
    try:
        _module(name).add_arguments(parser, *shared)
    except SplatliftError as error:  # its package is not installed
        parser.exit(BAD_INPUT, f"splatlift: {error}\n")


def _module(name: str) -> Any:
    """The file of a command.

    Raises:
        Unavailable: its package is not installed.
    """
    if name in COMMANDS:
        return import_module(f"liftcore.cli.{name}")
    return load_plugin("splatlift.commands", name)
