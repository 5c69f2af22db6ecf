"""``splatlift plan``: what a lift would do and need, without doing it; without features, what to encode first."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from liftcore.cli.lift import in_short, plan_of, settings_of
from liftcore.cli.options import Parser, add_settings, add_sources, add_verbose, count
from liftcore.cli.reply import reply
from liftcore.runtime.progress import progress_bars

if TYPE_CHECKING:
    from liftcore.values.settings import LiftSettings


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_sources(parser, "*", "; none: which photos to encode first, and what fewer would show")
    add_settings(parser)
    add_verbose(parser)
    parser.add_argument("--threads", type=count, metavar="N", help="of the lift; else as many as there are cores")


def run(options: argparse.Namespace) -> int:
    """Print the plan."""
    settings = settings_of(options)
    if not options.features:
        return _photos(options, settings)
    plan = plan_of(options, settings)
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
    from liftcore.io.cameras import read_cameras
    from liftcore.io.splats import read_splats
    from liftcore.lifting.planning.photos import plan_photos

    splats = read_splats(options.splats, settings.kernel, colour=False)
    with progress_bars() as progress:
        plan = plan_photos(
            splats, read_cameras(options.cameras), settings, threads=options.threads, progress=progress
        )
    reply(plan.facts(), as_json=options.json, lines=plan.lines(verbose=options.verbose))
    return 0
