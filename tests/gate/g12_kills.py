"""SIGKILL or SIGTERM to the server, or SIGKILL to all its children, at random moments of a line of lifts.

python -m tests.gate.g12_kills [--kills N] [--jobs N]
"""

from __future__ import annotations

import argparse
import random
import signal
import time
from collections import Counter
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import long_scene

ATTEMPTS = 3  # of a job, that the service promises; those that end with the server do not count
QUICK_SECONDS = 5.0  # to end where no request is open; a check, a busy machine and a job's end included


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Kill, until all jobs have ended and all kills are spent."""
    chance, victims = random.Random(options.seed), Counter[str]()
    with Service(folder / "data") as service:
        body = service.upload(long_scene())
        reference, duration = service.order_twice(body)
        digest = service.digest(reference)
        jobs = {f"job {number}": service.order(body, f"job {number}") for number in range(options.jobs)}
        child_kills, orphans, stops = Counter[str](), [0.0], list[tuple[int, float]]()
        while victims.total() < options.kills:
            time.sleep(chance.uniform(0, duration))
            records = {record["id"]: record["state"] for record in list_all(service, "jobs")}
            running = [job for job in jobs.values() if records.get(job) == "running"]
            if all(records.get(job) in ("succeeded", "failed") for job in jobs.values()):
                name = f"job {len(jobs)}"
                jobs[name] = service.order(body, name)
            elif chance.random() < 0.5 and running and child_kills[running[0]] < ATTEMPTS - 1:
                child_kills[running[0]] += 1
                victims["children"] += 1
                service.kill_children()
            else:
                number = chance.choice((signal.SIGKILL, signal.SIGTERM))
                victims[number.name] += 1
                status, seconds = service.timed_end(number)
                if number == signal.SIGTERM:
                    stops.append((status, seconds))
                orphans.append(service.orphan_seconds())
                service.start()
        states = Counter(service.wait_for(job)["state"] for job in jobs.values())
        lost_count = sum(service.order(body, name) != job for name, job in jobs.items())
        unlike = sum(
            service.digest(job) != digest for job in jobs.values() if service.wait_for(job)["state"] == "succeeded"
        )
        counts = {name: len(list_all(service, name)) for name in ("jobs", "lifts")}
        figures = f"{victims.total()} kills {dict(victims)}, {len(jobs)} jobs"
        verdicts.check("all jobs succeed", states == {"succeeded": len(jobs)}, f"{figures}, {dict(states)}")
        verdicts.check("none is lost: each key brings its job", not lost_count, lost_count)
        verdicts.check("none is doubled", set(counts.values()) == {len(jobs) + 2}, counts)
        verdicts.check("all have the same bits", not unlike, unlike)
        verdicts.check(
            "children end with their server, within 5 s", max(orphans) < 5, f"longest {max(orphans):.2f} s"
        )
        slowest = max((seconds for _, seconds in stops), default=0.0)
        is_quick = slowest < QUICK_SECONDS and not any(status for status, _ in stops)
        verdicts.check("SIGTERM: status 0, within 5 s", is_quick, f"{len(stops)} stops, slowest {slowest:.2f} s")
        verdicts.check_rest(service)


def list_all(service: Service, name: str) -> list[dict]:
    """All rows of /jobs or /lifts, of up to 1,000."""
    return service.client.get(f"/{name}", params={"limit": 1000}).json()[name]


if __name__ == "__main__":
    run_gate(gate, __doc__, kills=10, jobs=2)
