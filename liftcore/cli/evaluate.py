"""``splatlift evaluate``: evaluate lifts on LeRF-OVS and 3D-OVS, by the protocols of published methods."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, add_encoder, option_errors
from liftcore.cli.reply import reply

NAMES = {
    "data": "--data",
    "held_out": "--held-out",
    "give encoder=": "--table FILE or --encoder NAME",
    "negatives=": "--negative words",
}  # of arguments


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    from liftcore.models import METHODS

    parser.add_argument("dataset", choices=("lerf-ovs", "3d-ovs"), help="dataset of the labels")
    parser.add_argument(
        "lifts", nargs="+", metavar="LIFT", help="SCENE=LIFT, SCENE.lift.safetensors, or a folder of those"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the dataset, or its labels")
    add_encoder(parser)
    parser.add_argument("--protocol", nargs="+", choices=("P1", "P2", "P3", "own"), help="default: all")
    parser.add_argument(
        "--threshold", default="auto", metavar="T", help=f"of P2, P3 and own: {', '.join(METHODS)} or a number"
    )
    negative_help = "negative texts: all words up to the next option; may be repeated"
    parser.add_argument("--negative", nargs="+", action="extend", default=[], metavar="WORD", help=negative_help)
    parser.add_argument(
        "--held-out", type=Path, metavar="FILE", help="file of the frames to evaluate, one name a line"
    )


def run(options: argparse.Namespace) -> int:
    """Evaluate every lift of a labelled scene, and print the results with published ones."""
    from liftcore.evaluate import evaluate_lifts

    try:
        threshold = float(options.threshold)
    except ValueError:
        threshold = options.threshold
    with option_errors(NAMES):
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
