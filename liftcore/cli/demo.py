"""``splatlift demo``: the whole job on a small scene, through the real service."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    cameras = "cameras.json, transforms.json, cameras.zip or sparse/0"
    holds = f"its .ply; {cameras}; a feature pack; text_table.safetensors if any"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=f"a scene of your own ({holds}); else a still life")
    parser.add_argument(
        "--ask", action="append", default=[], metavar="TEXT", help="what to look for; may be given several times"
    )
    parser.add_argument("--out", type=Path, default=Path("demo-output"), metavar="DIR", help="of pictures and lift")


def run(options: argparse.Namespace) -> int:
    """Run the demo; it prints its own answers."""
    from liftcore.demo.run import run_demo

    return run_demo(options.scene, options.out, options.json, options.ask)
