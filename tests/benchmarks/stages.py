"""Processor seconds of each stage of a lift, files to result, and all as a multiple of geometry.

    python -m tests.benchmarks.stages FOLDER [--pack NAME] [--presets NAME...] [--rounds N] [--json]

All views are lifted on two threads, in one process; seconds are those of the round that took the fewest, with loading
kernels, without compiling them. FOLDER as `tests.benchmarks.scenes` makes it, or that of `plush` or `tabletop`.
"""

import time
from pathlib import Path
from unittest.mock import patch

import liftcore as lc
from liftcore.lifting.files import lift_files
from tests.benchmarks.base import command_line, print_rows, scene_files


def main() -> None:
    """Print the table."""
    parser = command_line(
        "tests.benchmarks.stages",
        __doc__,
        ("folder", {"type": Path}),
        ("--pack", {"default": "features"}),
        ("--presets", {"nargs": "+", "default": ["default", "row-sum"]}),
        ("--rounds", {"type": int, "default": 2}),
    )
    options = parser.parse_args()
    splats, cameras, pack = scene_files(options.folder, options.pack)
    best: dict[str, dict[str, float]] = {}
    for _ in range(max(1, options.rounds)):
        for preset in options.presets:
            settings, start = lc.LiftSettings.of(preset=preset, device="cpu"), time.process_time()
            with patch("liftcore.runtime.progress.time.perf_counter", time.process_time):
                lift = lift_files(splats, cameras, [pack], settings, threads=2)
            seconds = dict(lift.metadata.timings) | {"all": time.process_time() - start}
            if preset not in best or seconds["all"] < best[preset]["all"]:
                best[preset] = seconds
    rows = [
        {"preset": preset, **seconds, "all / geometry": seconds["all"] / seconds["geometry"]}
        for preset, seconds in best.items()
    ]
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
