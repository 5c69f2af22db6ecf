"""``splatlift experiment``: what the paper measured, on a scene of one's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.cli.reply import reply

if TYPE_CHECKING:
    import argparse


def run(options: argparse.Namespace) -> int:
    """Run one experiment; print its table, or its document with ``--json``; JSON and plot go to a folder."""
    from liftcore.evaluate.hardware import machine_line
    from tests.benchmarks.experiments.run import run_experiment, table_of

    document = run_experiment(options.name, options.scene, options.out, options.every)
    lines = [f"{document['title']} ({document['source']})", "", *table_of(document), ""]
    machine = machine_line(document["hardware"])
    lines += [f"{document['date']}, {document['seconds']:.0f} s on {machine}", *document["files"]]
    reply(document, as_json=options.json, lines=lines)
    return 0
