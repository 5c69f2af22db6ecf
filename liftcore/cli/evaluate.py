"""``splatlift evaluate``: evaluate a lift by labels of its views, by the protocol of *Splat Feature Solver*."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, add_encoder, add_fields, add_lift, encoder_spec, open_lift, option_errors
from liftcore.cli.query import FIELD_OVERRIDES
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    from liftcore import Query

    add_lift(parser)
    parser.add_argument("labels", type=Path, help="masks of phrases in its views, as 'splatlift pack prompts' writes")
    add_encoder(parser)
    add_fields(parser, Query, ("threshold", "negatives"), FIELD_OVERRIDES)


def run(options: argparse.Namespace) -> int:
    """Evaluate the lift, and print the figures."""
    from liftcore.evaluate import evaluate_lift

    names = {"labels": "LABELS", "negatives": "--negative", "give encoder=": "--table FILE or --encoder NAME"}
    with option_errors(names):
        evaluation = evaluate_lift(
            open_lift(options),
            options.labels,
            encoder=encoder_spec(options),
            threshold=options.threshold,
            negatives=options.negatives,
            progress=True,
        )
    reply(evaluation.document(), as_json=options.json, lines=evaluation.lines())
    return 0
