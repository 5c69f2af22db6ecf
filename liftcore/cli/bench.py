"""``splatlift bench``: measure the speed of lifts on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, add_device, count
from liftcore.cli.reply import reply


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR",
        help="point_cloud.ply, cameras and regions or features (.safetensors); default: a synthetic room",
    )
    parser.add_argument("--splats", type=count, metavar="N", help="splats of the synthetic scene")
    parser.add_argument("--size", metavar="WxH", help="image size of the synthetic scene")
    parser.add_argument("--channels", type=count, metavar="F", help="channels of the features; default 512")
    parser.add_argument("--levels", type=count, metavar="L", help="label levels; default 4")
    parser.add_argument("--views", type=count, metavar="N", help="largest number of views; default 8")
    parser.add_argument("--threads", type=count, metavar="N", help="default: the number of cores")
    parser.add_argument("--preset", metavar="NAME", help="one preset of lift; default: all")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware."""
    from liftcore.evaluate import run_bench

    names = ("scene", "splats", "size", "channels", "levels", "views", "threads", "preset", "device")
    values = {name: value for name in names if (value := getattr(options, name))}
    reply(run_bench(**values), as_json=options.json)
    return 0
