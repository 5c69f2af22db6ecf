"""``splatlift transfer``: transfer a lift to an edited or compressed copy of its splats."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from liftcore.cli.options import Parser, add_splats
from liftcore.cli.reply import check_outputs, reply, write_files
from liftcore.errors import InvalidInput

NUMBERS = (12, 16)  # of a matrix


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("edited", type=Path, help="other splats of its scene, of any format")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="NEW", help="the lift to write")
    matrix_help = "transform of the scene, a text file of 3 or 4 rows of 4 numbers; default: none"
    parser.add_argument("--matrix", type=Path, metavar="FILE", help=matrix_help)
    add_splats(parser)


def run(options: argparse.Namespace) -> int:
    """Write the lift of the other splats, and print the origin of their features."""
    from liftcore import Scene, load_lift

    files, scene = {"output": options.output}, Scene(options.lift, splats=options.splats)
    check_outputs(files, options, scene, kind="lift")
    matrix = None if options.matrix is None else _matrix(options.matrix)
    result = load_lift(options.lift).transferred(scene.splats, options.edited, matrix=matrix)
    write_files(files, {"output": partial(result.save, progress=True)})
    facts = result.diagnostics["transfer"]
    document: dict[str, Any] = {"out": str(options.output), "splats": len(result), **facts, "warnings": []}
    if unmatched := facts["without_partner"]:
        document["warnings"] = [
            f"{unmatched} of {len(result)} splats are near no splat of the lift, and have no feature"
        ]
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _matrix(path: Path) -> list[list[float]]:
    try:
        numbers = [float(word) for word in path.read_text(encoding="utf-8-sig").replace(",", " ").split()]
    except (OSError, ValueError) as error:
        raise InvalidInput("--matrix", expected="a file of 12 or 16 numbers", got=str(error)[:120]) from None
    if len(numbers) not in NUMBERS:
        raise InvalidInput("--matrix", expected="a file of 12 or 16 numbers", got=str(len(numbers)))
    return [numbers[first : first + 4] for first in range(0, len(numbers), 4)]


def _lines(document: dict[str, Any]) -> list[str]:
    lines = [f"{document['out']}: {document['splats']} splats, {document['rows']} of them rows of the lift"]
    return lines + [f"warning: {warning}" for warning in document["warnings"]]
