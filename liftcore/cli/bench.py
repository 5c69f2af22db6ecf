"""``splatlift bench``: how fast this machine lifts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_device, count
from liftcore.cli.reply import reply

if TYPE_CHECKING:
    from collections.abc import Iterator

_OPTIONS = ("scene", "splats", "size", "channels", "levels", "views", "threads", "preset", "stages", "aims", "device")


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
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--stages", action="store_true", help="every step of a view apart, on one thread")
    only.add_argument("--aims", action="store_true", help="the project's aims beside what this machine does")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware they were taken on."""
    from liftcore.evaluate.bench import run_bench

    document = run_bench({name: getattr(options, name) for name in _OPTIONS})
    lines = _steps(document) if options.stages else _aims(document) if options.aims else None
    reply(document, as_json=options.json, lines=lines)
    return 0


def _aims(document: dict[str, Any]) -> Iterator[str]:
    """The aims and what was found, for people."""
    yield _told(document)
    for preset, found in document["presets"].items():
        yield f"{preset}, load {found['load']:.1f}:"
        for figure in found["aims"]:
            aim = figure["aim"]
            told = "no aim here" if aim is None else f"aim {aim:g}, {'met' if figure['met'] else 'not met'}"
            yield f"  {figure['name']}: {figure['found']:.4g} ({told})"
        solved = ", ".join(f"{channels} channels {each:.4f}" for channels, each in found["solve_s_per_view"].items())
        yield f"  seconds a view: geometry {found['geometry_s_per_view']:.4f}; solution {solved}"


def _told(document: dict[str, Any]) -> str:
    """What was measured, and on what, in a line."""
    rest = {key: value for key, value in document.items() if key not in ("presets", "hardware")}
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in (rest | document["hardware"]).items())


def _steps(document: dict[str, Any]) -> Iterator[str]:
    """The steps of a view as a table for people."""
    yield _told(document)
    for preset, found in document["presets"].items():
        yield f"{preset}: seconds a view on one thread, median (smallest); load {found['load']:.1f}"
        for name, figures in found["stages"].items():
            wall, cpu = (f"{figures[key]:.4f} ({figures[f'{key}_min']:.4f})" for key in ("wall_s", "cpu_s"))
            yield f"  {name:<10}  wall {wall}  processor {cpu}"
