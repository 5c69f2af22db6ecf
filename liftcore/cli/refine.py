"""``splatlift refine``: smooth the features of a lift, without lifting again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from liftcore.cli.options import Parser, add_splats, count
from liftcore.cli.reply import reply, smoothing_line


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors or .shards)")
    smoothness_help = (
        "weight lambda of the smoothness term between splats near in position and colour, above 0; try 1"
    )
    parser.add_argument("--smoothness", type=float, required=True, metavar="L", help=smoothness_help)
    output_help = "the lift to write; default: LIFT with .smooth before its suffix"
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help=output_help)
    add_splats(parser)
    parser.add_argument("--threads", type=count, metavar="N", help="default: the number of cores")


def run(options: argparse.Namespace) -> int:
    """Smooth the lift's features, write it completely or not at all, and print how much they changed."""
    out = options.output
    if out is None:
        out = options.lift.with_name(f"{options.lift.stem}.smooth{options.lift.suffix}")
    from liftcore import Scene, load_lift
    from liftcore.files import check_output, writing

    scene = Scene(options.lift, splats=options.splats)
    file = check_output(out, [options.lift, scene.splat_file], "lift")
    result = load_lift(options.lift).refined(
        scene.splats, smoothness=options.smoothness, threads=options.threads, progress=True
    )
    with writing(file):
        result.save(out, progress=True)
    facts = result.diagnostics["smoothing"]
    document: dict[str, Any] = {
        "out": str(out),
        "splats": len(result),
        "channels": result.features.shape[1],
        "smoothing": facts,
        "seconds": result.metadata.timings["smooth"],
        "warnings": [facts["warning"]] if "warning" in facts else [],
    }
    lines = [f"{out}: {smoothing_line(facts)}, in {document['seconds']:.1f} s"]
    lines += [f"warning: {warning}" for warning in document["warnings"]]
    reply(document, as_json=options.json, lines=lines)
    return 0
