"""Stops and deaths as a client sees them: SIGTERM beside open requests, a stream taken up again.

python -m tests.gate.g11_stop
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import long_scene

OPEN_SECONDS = 15.0  # to end where a stream and half an upload are open


def gate(_: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Stop, kill and follow."""
    with Service(folder / "data") as service:
        body = service.upload(long_scene())
        stop_beside_open_requests(service, body, verdicts)
        resume_stream(service, body, verdicts)
        verdicts.check_rest(service)


def stop_beside_open_requests(service: Service, body: dict, verdicts: Verdicts) -> None:
    """SIGTERM while an event stream and half an upload are open."""
    job = service.order(body)

    def half_upload():
        yield b"ply\n"
        time.sleep(OPEN_SECONDS)
        yield b"format"

    def send_slowly() -> None:
        with contextlib.suppress(httpx.TransportError):
            service.client.put("/assets/splats", content=half_upload())

    with ThreadPoolExecutor(2) as pool:
        upload = pool.submit(send_slowly)
        stream = pool.submit(follow, service, job)
        time.sleep(1)
        status, seconds = service.timed_end(signal.SIGTERM)
        stream.result()
        upload.result()
    is_ended = status == 0 and seconds < OPEN_SECONDS
    verdicts.check("SIGTERM beside a stream and half an upload: status 0, within 15 s", is_ended, f"{seconds:.1f} s")
    service.start()
    verdicts.check("its job succeeds", service.wait_for(job)["state"] == "succeeded")


def resume_stream(service: Service, body: dict, verdicts: Verdicts) -> None:
    """Follow a job, be cut off by a kill, and go on after the last event."""
    job = service.order(body)
    service.wait_for(job, "running")
    with ThreadPoolExecutor(1) as pool:
        stream = pool.submit(follow, service, job)
        time.sleep(2)
        service.end(signal.SIGKILL)
        first = stream.result()
    service.start()
    latest = [number for number, _ in first if number]
    second = follow(service, job, latest[-1] if latest else None)
    numbers = [int(number) for number, _ in first + second if number]
    verdicts.check("a stream goes on after Last-Event-ID over a kill", numbers == sorted(set(numbers)), len(numbers))
    story = follow(service, job)
    ends = [event.get("state") for _, event in story].count("succeeded")
    verdicts.check("it ends with the last state, once", story[-1][1].get("state") == "succeeded" and ends == 1, ends)


def follow(service: Service, job: str, after: str | None = None) -> list[tuple[str, dict]]:
    """Number (empty where it has none) and data of a job's events, until the stream ends or breaks."""
    events, fields = [], {}
    headers = {"Last-Event-ID": after} if after else {}
    with (
        contextlib.suppress(httpx.TransportError),
        service.client.stream("GET", f"/jobs/{job}/events", headers=headers) as reply,
    ):
        for line in reply.iter_lines():
            name, _, value = line.partition(": ")
            if name:
                fields[name] = value
            elif "data" in fields:
                events.append((fields.get("id", ""), json.loads(fields["data"])))
                fields = {}
    return events


if __name__ == "__main__":
    run_gate(gate, __doc__)
