"""``splatlift plan``: what a lift would do and need, without doing it."""

from __future__ import annotations

import argparse

from liftcore.cli.lift import in_short, plan_of, settings_of
from liftcore.cli.options import Parser, add_settings, add_sources, add_verbose, count
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_sources(parser)
    add_settings(parser)
    add_verbose(parser)
    parser.add_argument("--threads", type=count, metavar="N", help="of the lift; else as many as there are cores")


def run(options: argparse.Namespace) -> int:
    """Print the plan."""
    plan = plan_of(options, settings_of(options))
    views = {"lifted": list(plan.views), "left_out": list(plan.left_out)}
    device = {"kind": plan.device.kind, "name": plan.device.name}
    document = {
        **plan.facts(),
        "seconds": plan.seconds,
        "device": device,
        "views": views,
        "warnings": [*plan.warnings, *plan.told],
    }
    reply(document, as_json=options.json, lines=plan.lines() if options.verbose else in_short(plan))
    return 0
