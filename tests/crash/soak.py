"""``make soak``: the long proofs, and their figures as one JSON object on stdout.

python -m tests.crash.soak [--kills N] [--seconds S] [--jobs N]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from liftcore.raster.cpu.warm_up import warm_up

from .loops import ALL_POINTS, POOLED, fault_points, kill_loop, leak_loop, scene_files


def main() -> int:
    """Run the loops; 1 when a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=7_200, help="no job of the kill loop begins after these")
    parser.add_argument("--jobs", type=int, default=50, help="of the leak test")
    given = parser.parse_args()
    warm_up()  # the undisturbed lift is timed, and kernels that it compiled first would stretch its time
    with tempfile.TemporaryDirectory() as folder:
        files = scene_files(Path(folder), views=30, splats=20_000, width=320)
    figures = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, Python {platform.python_version()}",
        "leaks": leak_loop(given.jobs),
        "points": fault_points(ALL_POINTS),
        "kills": kill_loop(files, kills=given.kills, seconds=given.seconds),
    }
    print(json.dumps(figures, indent=2))
    kills, growth = figures["kills"], figures["leaks"]["growth"]
    kept = kills["lost"] == kills["doubled"] == 0 and kills["digests_equal"] == kills["jobs"]
    level = growth["descriptors"] <= POOLED and growth["threads"] <= 1
    return 0 if kept and level and set(figures["points"].values()) == {"finished once"} else 1


if __name__ == "__main__":
    sys.exit(main())
