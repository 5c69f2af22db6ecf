"""A service under attack: started as a command, asked over HTTP, watched in /proc; and the verdicts of a script.

``SPLATLIFT`` of the environment is the command, else this checkout's. What a script starts carries a mark in its
environment, by which the script ends it and nothing else.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import hashlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, Self
from uuid import uuid4

import httpx
from safetensors.numpy import load

COMMAND = shlex.split(os.environ.get("SPLATLIFT", f"{sys.executable} -m liftcore.cli"))
RUN = f"GATE_RUN={uuid4().hex}"
PATIENCE_SECONDS = 600.0  # of a machine that has other things to do
FINAL_STATES = ("succeeded", "failed", "canceled")


class Service(httpx.Client):
    """A client of ``splatlift serve`` over a data directory; the process may be killed, stopped and started again."""

    def __init__(self, data: Path, **settings: object) -> None:
        # No connection is used twice: a server that was killed would be noticed at the next request only.
        super().__init__(timeout=PATIENCE_SECONDS, limits=httpx.Limits(max_keepalive_connections=0))
        self.data, self.log, self.mark = data, data.with_name(f"{data.name}.log"), f"{RUN}/{data.name}/"
        self.variables = {name: value for name, value in os.environ.items() if not name.startswith("SPLATLIFT")}
        self.variables |= {f"SPLATLIFT_{name.upper()}": str(value) for name, value in settings.items()}
        self.variables |= dict([self.mark.split("=")])
        self.process: subprocess.Popen[str]

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.end(signal.SIGKILL)
        self.close()

    def launch(self) -> int | None:
        """Start it; None once it listens, or the status with which it refused to."""
        with self.log.open("ab") as log:
            command = [*COMMAND, "serve", "--data", str(self.data), "--port", "0"]
            self.process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=log, text=True, env=self.variables
            )
        assert self.process.stdout is not None
        if not (line := self.process.stdout.readline()).startswith("listening on "):
            return self.process.wait(PATIENCE_SECONDS)
        self.base_url = line.split()[-1]
        return None

    def start(self) -> float:
        """Start it; seconds until its first answer."""
        start = time.monotonic()
        assert self.launch() is None, self.log.read_text()[-500:]
        assert self.get("/healthz").status_code == 200
        return time.monotonic() - start

    def end(self, number: signal.Signals) -> tuple[int, float]:
        """Send a signal to the HTTP process; its status, and the seconds that it still lived."""
        start = time.monotonic()
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_SECONDS), time.monotonic() - start

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run another command of `splatlift`; its status and output."""
        return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, env=self.variables, check=False)

    def upload(self, files: dict[str, bytes], **headers: str) -> dict[str, Any]:
        """Upload a scene; the body of an order of its lift."""
        replies = {
            kind: self.put(f"/assets/{kind}", content=content, headers=headers) for kind, content in files.items()
        }
        ids = {kind: reply.raise_for_status().json()["id"] for kind, reply in replies.items()}
        return ids | {"features": [ids["features"]]}

    def order(self, body: dict[str, Any], key: str | None = None) -> str:
        """Order a lift, with an Idempotency-Key where there is one; the job's id."""
        reply = self.post("/lift", json=body, headers={"Idempotency-Key": key} if key else None)
        return reply.raise_for_status().json()["id"]

    def order_twice(self, body: dict[str, Any]) -> tuple[str, float]:
        """Lift twice, as the first lift loads compiled code; return the second job and its seconds."""
        self.wait_for(self.order(body))
        job = self.order(body)
        record = self.wait_for(job)
        return job, record["ended"] - record["started"]

    def job(self, job: str) -> dict[str, Any]:
        """The job as it is now."""
        return self.get(f"/jobs/{job}").raise_for_status().json()

    def wait_for(self, job: str, *states: str) -> dict[str, Any]:
        """Poll the job until it is in one of the states, or has ended; return it."""
        deadline = time.monotonic() + PATIENCE_SECONDS
        while (record := self.job(job))["state"] not in (*states, *FINAL_STATES):
            assert time.monotonic() < deadline, record
            time.sleep(0.02)
        return record

    def digest(self, job: str) -> str:
        """Hash all tensors of the lift of a job."""
        tensors = load(self.get(f"/lifts/{job}/features").raise_for_status().content)
        parts = [f"{name} {tensors[name].dtype}".encode() + tensors[name].tobytes() for name in sorted(tensors)]
        return hashlib.sha256(b"".join(parts)).hexdigest()

    def children(self) -> set[int]:
        """The living processes of this service without the HTTP process."""
        return processes(self.mark) - {self.process.pid}

    def orphan_seconds(self) -> float:
        """Seconds until the children of a server that has ended are gone; at most ten."""
        start = time.monotonic()
        while self.children() and time.monotonic() - start < 10:
            time.sleep(0.05)
        return time.monotonic() - start

    def scratch(self) -> list[str]:
        """Names of what lies in the folders for scratch, which are empty at rest."""
        return [path.name for name in ("tmp", "work") for path in (self.data / name).glob("*")]


class Verdicts:
    """Promises that hold or do not, printed as they are judged."""

    def __init__(self) -> None:
        self.count = self.failures = 0

    def check(self, promise: str, holds: object, figures: object = "") -> None:
        """Judge a promise."""
        self.count, self.failures = self.count + 1, self.failures + (not holds)
        print("pass" if holds else "FAIL", promise, figures, flush=True)


def processes(mark: str) -> set[int]:
    """The living processes whose mark begins so."""
    pids = set()
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            is_marked = any(line.startswith(mark.encode()) for line in (entry / "environ").read_bytes().split(b"\0"))
            if is_marked and (entry / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                pids.add(int(entry.name))
    return pids


def send_signal(pids: set[int], number: signal.Signals) -> None:
    """Send a signal to each that still lives."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def run_gate(
    script: Callable[[argparse.Namespace, Path, Verdicts], None], doc: str | None, **counts: int
) -> NoReturn:
    """Run a script in a folder of its own, with counts as options; exit with 1 where a promise was broken."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, count in {**counts, "seed": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=count, help=f"default {count}")
    options, verdicts = parser.parse_args(), Verdicts()
    atexit.register(lambda: send_signal(processes(RUN), signal.SIGKILL))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    with tempfile.TemporaryDirectory(prefix="gate-") as folder:
        script(options, Path(folder), verdicts)
        deadline = time.monotonic() + 10
        while (remaining := processes(RUN)) and time.monotonic() < deadline:
            time.sleep(0.1)
        verdicts.check("no process of this run is left", not remaining, len(remaining))
    print(f"{verdicts.count - verdicts.failures} of {verdicts.count} promises hold")
    sys.exit(verdicts.failures > 0)
