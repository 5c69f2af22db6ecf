"""``make load``: what clients wait for under load, as one JSON object on stdout. Talks to 127.0.0.1 only.

python -m tests.load.measure [--seconds S] [--rounds N] [--splats P]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from datetime import UTC, datetime

from liftcore.raster.cpu.warm_up import warm_up

from .queries import query_loop
from .slow_clients import slow_loop

HEALTH_MS = 100.0
QUERY_SECONDS = 2.0
OTHER_SCENE = {"views": 60, "splats": 200_000, "width": 640}  # what is lifted meanwhile; it takes a minute or more


def main() -> int:
    """Run the loops; 1 when a bar was missed, which a busy machine does too, or no lift ran beside them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="of probing beside slow clients")
    parser.add_argument("--rounds", type=int, default=5, help="of 16 questions at once")
    parser.add_argument("--splats", type=int, default=1_000_000, help="of the lift that is asked")
    given = parser.parse_args()
    warm_up()
    begun = {
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        "machine": f"{os.cpu_count()} cores, Python {platform.python_version()}",
        "load_before": [round(load, 1) for load in os.getloadavg()],
    }
    slow = slow_loop(sockets=200, readers=20, seconds=given.seconds, beside=OTHER_SCENE)
    asked = query_loop(splats=given.splats, channels=512, queries=16, rounds=given.rounds, beside=OTHER_SCENE)
    print(json.dumps({**begun, "slow_clients": slow, "queries": asked}, indent=2))
    answered = slow["beside_them_ms"]["wrong"] == 0 and slow["drafts_left"] == 0
    quick = slow["beside_them_ms"]["p99"] < HEALTH_MS and asked["beside_a_lift"]["slowest_s"] < QUERY_SECONDS
    busy = slow["a_lift_ran"] and asked["beside_a_lift"]["a_lift_ran"]
    return 0 if answered and quick and busy else 1


if __name__ == "__main__":
    sys.exit(main())
