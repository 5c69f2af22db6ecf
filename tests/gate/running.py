"""A service under attack: started as a command, asked over HTTP, watched in /proc; and the verdicts of a script."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from tests.server import Server, digest_of_lift, wait_for_end


class Service(Server):
    """A service that takes scenes and orders; its process may be killed, stopped and started again."""

    def timed_end(self, number: signal.Signals) -> tuple[int, float]:
        """Send a signal to the HTTP process; its status, and the seconds that it still lived."""
        start = time.monotonic()
        return self.end(number), time.monotonic() - start

    def upload(self, files: dict[str, bytes]) -> dict[str, Any]:
        """Upload a scene; the body of an order of its lift."""
        replies = {kind: self.client.put(f"/assets/{kind}", content=content) for kind, content in files.items()}
        ids = {kind: reply.raise_for_status().json()["id"] for kind, reply in replies.items()}
        return ids | {"features": [ids["features"]]}

    def order(self, body: dict[str, Any], key: str | None = None) -> str:
        """Order a lift, with an Idempotency-Key where there is one; the job's id."""
        reply = self.client.post("/lift", json=body, headers={"Idempotency-Key": key} if key else None)
        return reply.raise_for_status().json()["id"]

    def order_twice(self, body: dict[str, Any]) -> tuple[str, float]:
        """Lift twice, as the first lift loads compiled code; return the second job and its seconds."""
        self.wait_for(self.order(body))
        job = self.order(body)
        record = self.wait_for(job)
        return job, record["ended"] - record["started"]

    def wait_for(self, job: str, *states: str) -> dict[str, Any]:
        """Poll the job until it is in one of the states, or has ended; return it."""
        return wait_for_end(self.client, f"/jobs/{job}", *states)

    def digest(self, job: str) -> str:
        """Hash all of the lift of a job that does not tell of time."""
        return digest_of_lift(self.client, f"/lifts/{job}")

    def children(self) -> set[int]:
        """The living processes of this service without the HTTP process."""
        return {*self.processes()} - {self.pid}

    def orphan_seconds(self) -> float:
        """Seconds until the children of a server that has ended are gone; at most ten."""
        start = time.monotonic()
        while self.children() and time.monotonic() - start < 10:
            time.sleep(0.05)
        return time.monotonic() - start

    def scratch(self) -> list[str]:
        """Names of what lies in the folders for scratch, which are empty at rest: after ten seconds at most."""
        start = time.monotonic()
        while names := [path.name for folder in ("tmp", "work") for path in (self.data / folder).glob("*")]:
            if time.monotonic() - start > 10:
                break
            time.sleep(0.1)
        return names


class Verdicts:
    """Promises that hold or do not, printed as they are judged."""

    def __init__(self) -> None:
        self.count = self.failures = 0

    def check(self, promise: str, holds: object, figures: object = "") -> None:
        """Judge a promise."""
        self.count, self.failures = self.count + 1, self.failures + (not holds)
        print("pass" if holds else "FAIL", promise, figures, flush=True)

    def check_rest(self, service: Service) -> None:
        """Judge readiness, and the folders for scratch."""
        self.check("the service is alive and ready", service.client.get("/readyz").status_code == 200)
        names = service.scratch()
        self.check("nothing lies in the scratch folders", not names, names[:3])


def run_gate(
    script: Callable[[argparse.Namespace, Path, Verdicts], None], doc: str | None, **counts: int
) -> NoReturn:
    """Run a script in a folder of its own, with counts as options; exit with 1 where a promise was broken."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, count in {**counts, "seed": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=count, help=f"default {count}")
    options, verdicts = parser.parse_args(), Verdicts()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    with tempfile.TemporaryDirectory(prefix="gate-") as folder:
        script(options, Path(folder), verdicts)
    print(f"{verdicts.count - verdicts.failures} of {verdicts.count} promises hold")
    sys.exit(verdicts.failures > 0)
