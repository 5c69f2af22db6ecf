"""``splatlift bench``: how fast this machine lifts."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, add_device, count
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR",
        help="point_cloud.ply, cameras and regions or features (.safetensors); else a synthetic room",
    )
    parser.add_argument("--splats", type=count, metavar="N", help="splats of the synthetic scene")
    parser.add_argument("--size", metavar="WxH", help="image size of the synthetic scene")
    parser.add_argument("--channels", type=count, metavar="F", help="of the features; else 512")
    parser.add_argument("--levels", type=count, metavar="L", help="label levels; else 4")
    parser.add_argument("--views", type=count, metavar="N", help="at most; else 8")
    parser.add_argument("--threads", type=count, metavar="N", help="else as many as there are cores")
    parser.add_argument("--preset", metavar="NAME", help="one of lift's presets alone; else all")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware they were taken on."""
    from liftcore.evaluate import run_bench

    names = ("scene", "splats", "size", "channels", "levels", "views", "threads", "preset", "device")
    values = {name: value for name in names if (value := getattr(options, name))}
    reply(run_bench(**values), as_json=options.json)
    return 0
