"""``splatlift tradeoff``: speed against accuracy on one's own scene, as a chart, a table and JSON."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from liftcore.cli.bars import progress_bars
from liftcore.cli.lift import pairs_of
from liftcore.cli.reply import free_output, reply, writing
from liftcore.errors import InvalidSettings
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    import argparse

COMPARED = ("preset", "speed")


def run(options: argparse.Namespace) -> int:
    """Compare, write the chart, the table and the JSON, and say what to take."""
    settings = pairs_of(options.set)
    LiftSettings.of(**settings)
    for name in COMPARED:
        if name in settings:
            raise InvalidSettings("--set", expected="settings that are the same in all runs", got=name)
    from liftcore.evaluate.tradeoff.compare import compare
    from liftcore.evaluate.tradeoff.order import Scene
    from liftcore.evaluate.tradeoff.report import page_of, save

    free_output(options.out / "tradeoff.json", [])
    scene = Scene(
        options.splats,
        options.cameras,
        tuple(options.features),
        options.labels,
        options.table,
        tuple(options.classes),
    )
    with progress_bars() as progress:
        found = compare(scene, options.budget, settings, options.threads, progress)
    document = {
        "title": "Speed against accuracy",
        "scene": options.splats.resolve().parent.name,
        "command": _command(options),
        **found,
    }
    with writing(options.out):
        files = save(document, options.out)
    document["files"] = [str(file) for file in files]
    reply(document, as_json=options.json, lines=[*page_of(document), "", *document["files"]])
    return 0


def _command(options: argparse.Namespace) -> str:
    """The command that makes this comparison again."""
    parts = ["splatlift", "tradeoff", str(options.splats), str(options.cameras), *map(str, options.features)]
    parts += ["--budget", f"{options.budget:g}"]
    for pair in options.set:
        parts += ["--set", pair]
    if options.threads:
        parts += ["--threads", str(options.threads)]
    if options.labels:
        parts += ["--labels", str(options.labels), "--table", str(options.table), "--classes", *options.classes]
    return shlex.join(parts)
