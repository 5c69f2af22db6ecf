"""Cancels at random moments of lifts, trade-offs and jobs in line: complete within two seconds.

python -m tests.gate.g13_cancels [--cancels N]
"""

from __future__ import annotations

import argparse
import random
import time
from collections import Counter
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import long_scene

CANCEL_SECONDS = 2.0
KINDS = ("lift", "lift", "tradeoff", "in line")


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Cancel, and look at once for what is left."""
    chance = random.Random(options.seed)
    with Service(folder / "data") as service:
        body = service.upload(long_scene())
        duration, resting = service.order_twice(body)[1], len(service.children())
        seconds, broken, kinds, number = [], [], Counter[str](), 0
        while len(seconds) < options.cancels and number < 3 * options.cancels:
            kind = KINDS[number % len(KINDS)]
            number += 1
            other = service.order(body) if kind == "in line" else None
            is_tradeoff = kind == "tradeoff"
            order = body | {"budget_s": 10} if is_tradeoff else body
            order = {name: order[name] for name in order if not (is_tradeoff and name == "table")}
            accepted = service.client.post("/tradeoff" if is_tradeoff else "/lift", json=order)
            job = accepted.raise_for_status().json()["id"]
            time.sleep(chance.uniform(0, duration))
            start = time.monotonic()
            reply = service.client.post(f"/jobs/{job}/cancel")
            state = service.wait_for(job)["state"]
            if state == "canceled":
                seconds.append(time.monotonic() - start)
                kinds[kind] += 1
                if other is None and len(service.children()) > resting:
                    broken.append(f"{kind}: {len(service.children())} processes, {resting} at rest")
                if any(service.client.get(f"/{name}/{job}").status_code != 404 for name in ("lifts", "tradeoffs")):
                    broken.append(f"{kind}: it has a result")
            if reply.is_success != (state == "canceled"):
                broken.append(f"{kind}: {reply.status_code}, then {state}")
            if other is not None:
                service.client.post(f"/jobs/{other}/cancel")
                service.wait_for(other)
        figures = f"{len(seconds)} {dict(kinds)}, slowest {max(seconds):.2f} s"
        verdicts.check("canceled within 2 s", max(seconds) < CANCEL_SECONDS, figures)
        verdicts.check("canceled: no process, no result; too late: refused", not broken, broken[:3])
        verdicts.check_rest(service)


if __name__ == "__main__":
    run_gate(gate, __doc__, cancels=8)
