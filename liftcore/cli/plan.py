"""``splatlift plan``: what a lift would do and need, without doing it; without features, what to encode first."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from liftcore.cli.lift import in_short, settings_of
from liftcore.cli.options import Parser, add_settings, add_sources, add_verbose, count
from liftcore.cli.reply import reply

if TYPE_CHECKING:
    from liftcore import LiftSettings

NO_LOOK = (
    "smoothness adds no look: these shares are of what photos show, and splats that none of them sees take their "
    "neighbours' features, still counted as unseen"
)


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_sources(parser, "*", "; none: which photos to encode first, and what fewer would show")
    add_settings(parser)
    add_verbose(parser)
    parser.add_argument("--threads", type=count, metavar="N", help="of the lift; else as many as there are cores")


def run(options: argparse.Namespace) -> int:
    """Print the plan."""
    from liftcore import plan_files

    settings = settings_of(options)
    if not options.features:
        return _photos(options, settings)
    plan = plan_files(options.splats, options.cameras, options.features, settings, threads=options.threads)
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


def _photos(options: argparse.Namespace, settings: LiftSettings) -> int:
    """Print which photos to encode first."""
    from liftcore import plan_photos, read_cameras, read_splats

    splats = read_splats(options.splats, settings.kernel, colour=False)
    plan = plan_photos(splats, read_cameras(options.cameras), settings, threads=options.threads, progress=True)
    lines = [*plan.lines(verbose=options.verbose)]
    if settings.smoothness:
        lines.append(NO_LOOK)
    reply(plan.facts(), as_json=options.json, lines=lines)
    return 0
