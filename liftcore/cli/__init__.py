"""Public: ``splatlift``, the command line.

Each command is ``add_arguments`` and ``run`` of a module, here or in the service's package. In `SHARED` modules the
command's name is behind them.

Exit status: 0 for success; 2 for invalid input, with one line on stderr; 1 for an internal error. With ``--json``
stdout has exactly one JSON object.
"""

import argparse
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from liftcore import __version__, load_command
from liftcore.cli.options import BAD_INPUT, Parser, shared_options, whole_number, wrong_kind_error
from liftcore.errors import SplatliftError

__all__ = ["Parser", "build_parser", "main", "whole_number"]  # for commands of other packages
COMMANDS = {
    "check": "check that splats, cameras, photos and features match",
    "lift": "lift features onto splats",
    "transfer": "transfer a lift to an edited copy of its splats",
    "plan": "plan a lift: views and memory",
    "query": "find words and examples in a lift",
    "segment": "label every splat of a lift with the best of many words",
    "objects": "list the objects in a lift",
    "export": "export a lifted scene with its labels",
    "render": "render a lift from any camera",
    "pack": "convert features or masks to a feature pack",
    "encode": "encode images as a feature pack",
    "inspect": "describe a file and its problems",
    "evaluate": "evaluate a lift by labels of its views",
    "tradeoff": "compare speed and accuracy on a scene",
}
SHARED = {  # modules of commands beside another one
    "plan": "lift", "transfer": "lift", "render": "export", "encode": "pack", "objects": "segment",
    **dict.fromkeys(("inspect", "check", "tradeoff"), "evaluate"),
}  # fmt: skip
SERVICE_COMMANDS = {  # modules of the package service
    "demo": "run a complete example through the HTTP service",
    "serve": "run the HTTP service",
    "view": "show a lift on the service's page, until Ctrl-C",
    "keys": "manage the API keys of the HTTP service",
    "store": "back up, verify and clean the HTTP service's data",
}
WITH_ACTIONS = ("keys", "pack", "store")  # whose actions take the shared options
INTERNAL_ERROR = 1
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit status."""
    options = argparse.Namespace(debug=False)
    try:
        words = sys.argv[1:] if argv is None else argv
        options = build_parser().parse_args(words)
        options.command_line = shlex.join(["splatlift", *words])
        status = _function(options.command, "run")(options)
        sys.stdout.flush()
        return status
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    except SplatliftError as error:
        print(f"splatlift: {wrong_kind_error(options) or error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("splatlift: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of stdout closed it; the rest of the buffer is discarded without an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return INTERNAL_ERROR
    except Exception as error:
        if options.debug:
            raise
        message = " ".join(f"{type(error).__name__}: {error}".split())[:400]
        print(f"splatlift: internal error: {message} (--debug shows the traceback)", file=sys.stderr)
        return INTERNAL_ERROR


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of all commands. Options of a command are added, and its modules imported, only if it runs."""
    parser = Parser(prog="splatlift", description="Lift 2D features onto trained splats and query them in words.")
    parser.add_argument("--version", action="version", version=f"splatlift {__version__}")
    shared = shared_options()
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, description in (SERVICE_COMMANDS | COMMANDS).items():
        command = commands.add_parser(name, parents=[] if name in WITH_ACTIONS else [shared], help=description)
        command.fill = partial(_add_options, name, command, [shared] if name in WITH_ACTIONS else [])
    return parser


def _add_options(name: str, parser: Parser, shared: list[Parser]) -> None:
    try:
        _function(name, "add_arguments")(parser, *shared)
    except SplatliftError as error:  # its package is not installed
        parser.exit(BAD_INPUT, f"splatlift: {error}\n")


def _function(command: str, name: str) -> Callable[..., Any]:
    """Import a function of a command."""
    if command in SERVICE_COMMANDS:
        return getattr(load_command(command), name)
    module = import_module(f"liftcore.cli.{SHARED.get(command, command)}")
    return getattr(module, f"{name}_{command}" if command in SHARED else name)
