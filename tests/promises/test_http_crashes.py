"""A server and its children that are killed: each accepted job ends once, with the result of an undisturbed one."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.server import FINAL_STATES, Server, digest_of_lift, until, wait_for_end
from tests.tiny_scene import TinyScene

from .over_http import events_of, upload, upload_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def start(tmp_path: Path, encoder: str) -> Callable[..., Server]:
    """Start servers over the test's own data directory."""
    return lambda **settings: Server(tmp_path / "data", encoder=encoder, **settings)


def state_of(server: Server, job: str) -> str:
    return server.client.get(job).json()["state"]


def times_succeeded(server: Server, job: str) -> int:
    story = events_of(server.client.get(f"{job}/events").text)
    return sum(name == "state" and data["state"] == "succeeded" for _, name, data in story)


def kill_attempt(server: Server, job: str, attempt: int) -> dict[str, Any]:
    """Kill what the server started until an attempt at the job is over; return the job."""

    def over() -> dict[str, Any] | None:
        record = server.client.get(job).json()
        if record["state"] in FINAL_STATES or record["attempt"] > attempt:
            return record
        if record["state"] == "running":
            server.kill_children()
            time.sleep(0.1)
        return None

    return until(over)


def test_killed_server_finishes_each_job_once_with_the_same_digest(
    start: Callable[..., Server], tiny: TinyScene
) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        jobs = []

        def order_job(key: str) -> httpx.Response:
            return server.client.post("/lift", json=body, headers={"Idempotency-Key": key})

        undisturbed = order_job("undisturbed").headers["location"]
        assert wait_for_end(server.client, undisturbed)["state"] == "succeeded"
        for number in range(3):  # as often as a job has attempts: a fault of the server is none of its
            reply = order_job(str(number))
            assert reply.status_code == 202
            jobs.append(reply.headers["location"])
            until(lambda: state_of(server, jobs[0]) == "running")
            server.kill()  # at once after the order
            until(lambda: not server.processes())  # its children end with it
            server.start()
            assert [order_job(str(each)).status_code for each in range(number + 1)] == [200] * (number + 1)
            until(lambda: state_of(server, jobs[0]) in ("running", *FINAL_STATES))
        assert server.stop() == 0  # nor does a stop count
        until(lambda: not server.processes())
        server.start()
        until(lambda: state_of(server, jobs[0]) in ("running", *FINAL_STATES))
        record = server.client.get(jobs[0]).json()
        if record["state"] == "running":  # a first fault of its own, after four that were not
            kill_attempt(server, jobs[0], record["attempt"])
        for number, job in enumerate(jobs):
            assert wait_for_end(server.client, job)["state"] == "succeeded"
            assert order_job(str(number)).headers["location"] == job
            assert times_succeeded(server, job) == 1
        lifts = [entry["links"]["self"] for entry in server.client.get("/lifts").json()["lifts"]]
        assert len(lifts) == 4 == len(server.client.get("/jobs").json()["jobs"])
        assert len({digest_of_lift(server.client, lift) for lift in lifts}) == 1
        assert server.client.get(f"/assets/{body['splats']}/content").content == tiny.splats


def test_job_whose_process_is_killed_goes_on_until_its_third_attempt(
    start: Callable[..., Server], tiny: TinyScene
) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        once, always = (server.client.post("/lift", json=body).headers["location"] for _ in range(2))
        assert kill_attempt(server, once, 1)["attempt"] == 2
        record = wait_for_end(server.client, once)
        assert (record["state"], times_succeeded(server, once)) == ("succeeded", 1)
        record = kill_attempt(server, always, 3)
        assert (record["state"], record["attempt"]) == ("failed", 3)
        assert record["problem"]["type"] == "/problems/crashed" and record["problem"]["detail"]
        assert server.client.get(f"/lifts/{record['id']}").status_code == 404

        # What else a child does works again: checks and questions.

        def first_answer() -> httpx.Response | None:
            reply = server.client.get("/query", params={"text": "lamp"})
            return reply if reply.status_code == 200 else None

        assert until(first_answer).json()["count"] == 20
        server.kill_children()
        assert until(first_answer).json()["count"] == 20
        upload(server.client, "table", tiny.table)
        assert server.is_alive()
