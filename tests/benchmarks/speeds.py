"""The setting ``quality`` on one scene: processor seconds of whole lifts by turns, and how near to exact they come.

    python -m tests.benchmarks.speeds FOLDER [--quality NAME...] [--preset NAME] [--rounds N] [--json]

All views are lifted, on one thread, in one process; seconds are the fewest of the rounds, with reading, without
compiling. ``splatlift tradeoff`` measures more, with views held out. FOLDER as `tests.benchmarks.scenes` makes it.
"""

import time
from pathlib import Path

import liftcore as lc
from liftcore.evaluate.accuracy import cosine_figures
from liftcore.lifting.files import lift_files
from liftcore.values.settings import Quality
from tests.benchmarks.base import command_line, print_rows, scene_files


def main() -> None:
    """Print the table."""
    parser = command_line(
        "tests.benchmarks.speeds",
        __doc__,
        ("folder", {"type": Path}),
        ("--quality", {"nargs": "+", "default": list(map(str, Quality)), "choices": list(map(str, Quality))}),
        ("--preset", {"default": "default"}),
        ("--rounds", {"type": int, "default": 2}),
    )
    options = parser.parse_args()
    splats, cameras, pack = scene_files(options.folder)
    seconds: dict[str, float] = {}
    lifts: dict[str, lc.LiftResult] = {}
    for number in range(1 + max(1, options.rounds)):  # the first round compiles
        for level in dict.fromkeys(["exact", *options.quality]):
            start = time.process_time()
            settings = lc.LiftSettings.of(preset=options.preset, quality=level, device="cpu")
            lifts[level] = lift_files(splats, cameras, [pack], settings, threads=1)
            if number:
                seconds[level] = min(seconds.get(level, float("inf")), time.process_time() - start)
    exact = lifts["exact"]
    rows = [
        {
            "quality": level,
            "views": len(lifted.metadata.views),
            "processor s": seconds[level],
            "times less": seconds["exact"] / seconds[level],
            **cosine_figures(lifted.features, exact.features, exact.total_weight),
            "expected of the views": lifted.metadata.diagnostics["plan"]["view_cosine"],
        }
        for level, lifted in lifts.items()
    ]
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
