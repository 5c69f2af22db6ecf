"""``splatlift tradeoff``: compare speed and accuracy on a scene, as a chart, a table and JSON."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.lift import pairs_of
from liftcore.cli.options import Parser, add_sources, count, option_errors
from liftcore.cli.reply import check_outputs, reply


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    add_sources(parser)
    parser.add_argument("--budget", type=_seconds, default=600.0, metavar="SECONDS", help="time limit; default 600")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("tradeoff"), metavar="DIR", help="folder of the output"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting of all runs; preset: of the runs that differ in quality",
    )
    parser.add_argument("--labels", type=Path, metavar="MASKS", help="VIEW/mask [h, w], class numbers")
    parser.add_argument("--table", type=Path, metavar="FILE", help="text embeddings of the classes")
    parser.add_argument("--classes", nargs="+", default=[], metavar="WORD", help="the classes, from number 0 on")
    parser.add_argument("--threads", type=count, metavar="N", help="default: the number of cores")


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected seconds, got {text!r}")
    return value


def run(options: argparse.Namespace) -> int:
    """Compare, write the chart, the table and the JSON, and print the recommendation."""
    settings = pairs_of(options.set)
    from liftcore.evaluate import SceneFiles, compare_speeds
    from liftcore.files import writing

    check_outputs({"output": options.out / "tradeoff.json"}, options, kind="json")
    sources = options.splats, options.cameras, tuple(options.features)
    with option_errors({"settings": "--set"}):
        comparison = compare_speeds(
            SceneFiles(*sources, options.labels, options.table, tuple(options.classes)),
            budget=options.budget,
            settings=settings,
            threads=options.threads,
            progress=True,
            scene=options.splats.resolve().parent.name,
            command=options.command_line,
        )
    with writing(options.out):
        files = comparison.save(options.out)
    document = comparison.document | {"files": [str(file) for file in files]}
    reply(document, as_json=options.json, lines=[*comparison.lines(), "", *document["files"]])
    return 0
