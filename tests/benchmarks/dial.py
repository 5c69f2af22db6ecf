"""The dial on one scene: processor seconds of whole lifts by turns, and how near they come to the exact one.

    python -m tests.benchmarks.dial FOLDER [--features NAME] [--speeds NAME...] [--rounds N] [--preset NAME]

FOLDER holds ``point_cloud.ply``, ``cameras.json`` and a feature pack, as `tests.benchmarks.room_scene` makes it. All
views are lifted, on one thread, in one process; seconds are the fewest of the rounds, plan and pilot among them,
without reading files and compiling. ``splatlift tradeoff`` measures more, with views held out.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.device import CPU
from liftcore.evaluate.hardware import hardware, machine_line
from liftcore.evaluate.tradeoff.judge import cosine_figures
from liftcore.io.input_files import input_files
from liftcore.lift import Run, lift_sources, open_sources
from liftcore.listener import NOBODY
from liftcore.settings import LiftSettings, Preset, Speed
from liftcore.timings import Timings
from liftcore.warm_up import warm_up_lift

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.io.lift_file import LiftResult

PACK = "features.safetensors"


def measure_dial(
    folder: Path, speeds: Sequence[Speed], rounds: int, preset: Preset, pack: str = PACK
) -> list[dict[str, Any]]:
    """A row of plain numbers for each speed, ``exact`` first whether it is asked for or not."""
    splats, cameras, features = (folder / name for name in ("point_cloud.ply", "cameras.json", pack))
    inputs = input_files(splats, cameras, [features])
    chosen = list(dict.fromkeys([Speed.EXACT, *speeds]))
    seconds: dict[Speed, float] = {}
    made: dict[Speed, LiftResult] = {}
    for _ in range(rounds):
        for speed in chosen:
            settings = LiftSettings.of(preset=preset, speed=speed, device="cpu")
            sources = open_sources(splats, cameras, [features], settings)
            warm_up_lift(sources.splats.kernel, CPU, settings)
            begin = time.process_time()
            made[speed] = lift_sources(Run(settings, 1, NOBODY, Timings(), CPU), sources, inputs)
            seconds[speed] = min(seconds.get(speed, float("inf")), time.process_time() - begin)
    exact = made[Speed.EXACT]
    return [
        {
            "speed": speed.value,
            "views": len(one.metadata.views),
            "expected": one.metadata.certificate["plan"]["view_cosine"],
            "processor_seconds": seconds[speed],
            "less_than_exact": seconds[Speed.EXACT] / seconds[speed],
            **cosine_figures(one.features, exact.features, exact.evidence),
        }
        for speed, one in made.items()
    ]


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """The rows for people, and the machine."""
    lines = [f"{'dial':<10}{'views':>6}{'processor s':>13}{'less':>7}  cosine by evidence / plain / 5 % below"]
    for row in rows:
        cosines = " / ".join(f"{row[key]:.4f}" for key in ("cosine", "cosine_plain", "cosine_q05"))
        expected = f" (expected of the views {row['expected']:.4f})" if row["expected"] else ""
        lines.append(
            f"{row['speed']:<10}{row['views']:>6}{row['processor_seconds']:>13.2f}{row['less_than_exact']:>6.1f}x"
            f"  {cosines}{expected}"
        )
    lines.append(machine_line(hardware()))
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.dial", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--features", default=PACK, metavar="NAME", help="the pack in FOLDER")
    parser.add_argument("--speeds", nargs="+", type=Speed, default=list(Speed), choices=list(Speed), metavar="NAME")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--preset", type=Preset, default=Preset.TIKHONOV, choices=list(Preset), metavar="NAME")
    given = parser.parse_args(arguments)
    if given.rounds < 1:
        parser.error(f"--rounds: expected one at least, got {given.rounds}")
    print(table_of(measure_dial(given.folder, given.speeds, given.rounds, given.preset, given.features)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
