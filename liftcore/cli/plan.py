"""``splatlift plan``: what a lift would do and need, without doing it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.cli.lift import plan_of, settings_of
from liftcore.cli.reply import reply

if TYPE_CHECKING:
    import argparse


def run(options: argparse.Namespace) -> int:
    """Print the plan."""
    plan = plan_of(options, settings_of(options))
    views = {"lifted": list(plan.views), "left_out": list(plan.left_out)}
    today = plan.on_device.today() if plan.on_device else {}
    device = {"kind": plan.device.kind, "name": plan.device.name, **today}
    document = {**plan.facts(), "device": device, "views": views, "warnings": [*plan.warnings, *plan.told]}
    reply(document, as_json=options.json, lines=plan.lines())
    return 0
