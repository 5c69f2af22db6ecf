"""``splatlift evaluate``: lifts against the labels of LeRF-OVS and 3D-OVS, in the protocols of the field."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, add_encoder, renamed
from liftcore.cli.reply import reply

NAMES = {
    "data": "--data",
    "held_out": "--held-out",
    "give encoder=": "--table FILE or --encoder NAME",
    "negatives=": "--negative words",
}  # of arguments


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    from liftcore.models import METHODS

    parser.add_argument("dataset", choices=("lerf-ovs", "3d-ovs"), help="whose labels")
    parser.add_argument(
        "lifts", nargs="+", metavar="LIFT", help="SCENE=LIFT, SCENE.lift.safetensors, or a folder of those"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the dataset, or its labels")
    add_encoder(parser)
    parser.add_argument("--protocol", nargs="+", choices=("P1", "P2", "P3", "own"), help="else all")
    parser.add_argument(
        "--threshold", default="auto", metavar="T", help=f"of P2, P3 and own: {', '.join(METHODS)} or a number"
    )
    competitors = "texts to compete with: all up to the next option; may be given several times"
    parser.add_argument("--negative", nargs="+", action="extend", default=[], metavar="WORD", help=competitors)
    parser.add_argument("--held-out", type=Path, metavar="FILE", help="the only frames to judge, a name a line")


def run(options: argparse.Namespace) -> int:
    """Judge every lift whose scene is labelled, and print what was measured beside what was published."""
    from liftcore.evaluate import evaluate_lifts

    try:
        threshold = float(options.threshold)
    except ValueError:
        threshold = options.threshold
    with renamed(NAMES):
        evaluation = evaluate_lifts(
            options.dataset,
            options.lifts,
            options.data,
            encoder=f"table:{options.table}" if options.table else options.encoder or None,
            threshold=threshold,
            negatives=options.negative,
            held_out=options.held_out,
            progress=True,
            **({"protocols": options.protocol} if options.protocol else {}),
        )
    reply(evaluation.document(), as_json=options.json, lines=evaluation.lines())
    return 0
