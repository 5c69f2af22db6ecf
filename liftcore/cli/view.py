"""``splatlift view``: a lift on the service's page, in place of this process."""

import argparse

from liftcore.cli.options import Parser
from liftcore.cli.serve import become
from liftcore.io.remote import place


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument(
        "lift", type=place, help="a lift (.safetensors), whose splats and cameras are where they were"
    )
    parser.add_argument("--port", type=int, default=0, help="the port of this machine; 0 picks a free one")
    parser.add_argument("--no-browser", action="store_true", help="print the address, and open nothing")


def run(options: argparse.Namespace) -> int:
    """Become a server of this lift alone, until Ctrl-C."""
    more = ["--no-browser"] if options.no_browser else []
    become("service.view", [str(options.lift), "--port", str(options.port), *more])
