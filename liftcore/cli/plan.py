"""``splatlift plan``: plan a lift."""

from __future__ import annotations

import argparse

from liftcore.cli.lift import plan_lines, settings_of
from liftcore.cli.options import Parser, add_settings, add_sources, add_verbose, count
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    add_sources(parser)
    add_settings(parser)
    add_verbose(parser)
    parser.add_argument(
        "--threads", type=count, metavar="N", help="threads of the lift; default: the number of cores"
    )


def run(options: argparse.Namespace) -> int:
    """Print the plan."""
    from liftcore import plan_files

    settings = settings_of(options)
    plan = plan_files(options.splats, options.cameras, options.features, settings, threads=options.threads)
    views = {"lifted": list(plan.views), "left_out": list(plan.left_out)}
    device = {"kind": plan.device.kind, "name": plan.device.name}
    document = {
        **plan.facts(),
        "seconds": plan.seconds,
        "device": device,
        "views": views,
        "warnings": list(plan.warnings),
    }
    reply(document, as_json=options.json, lines=plan.lines() if options.verbose else plan_lines(plan))
    return 0
