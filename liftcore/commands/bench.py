"""``splatlift bench``: how fast this machine lifts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.commands.reply import reply

if TYPE_CHECKING:
    import argparse

_OPTIONS = ("scene", "splats", "size", "channels", "levels", "views", "threads")


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware they were taken on."""
    from liftcore.measure.bench import run_bench

    reply(run_bench({name: getattr(options, name) for name in _OPTIONS}), as_json=options.json)
    return 0
