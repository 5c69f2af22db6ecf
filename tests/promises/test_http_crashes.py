"""A server and its children that are killed: each accepted job ends once, with the result of an undisturbed one."""

from __future__ import annotations

import signal
import time
from typing import Any

import httpx
import pytest

from tests.server import FINAL_STATES, Server, digest_of_lift, until, wait_for_end
from tests.tiny_scene import TinyScene

from .over_http import assert_problem, delete_lift, events_of

pytestmark = pytest.mark.slow


def times_succeeded(client: httpx.Client, job: str) -> int:
    story = events_of(client.get(f"{job}/events").text)
    return sum(name == "state" and data["state"] == "succeeded" for _, name, data in story)


ATTEMPTS = 3  # of a job, that the service promises


def kill_attempts(server: Server, job: str, count: int) -> dict[str, Any]:
    """Kill what the server started until so many attempts at a job are over; return the job."""

    def over() -> dict[str, Any] | None:
        record = server.client.get(job).json()
        if record["state"] in FINAL_STATES or record["attempt"] > count:
            return record
        if record["state"] == "running":
            server.kill_children()
            time.sleep(0.1)  # until the attempt is over, so that the next one is not hit
        return None

    return until(over)


def job_killed(server: Server, order: dict[str, Any], count: int) -> tuple[str, dict[str, Any]]:
    """Order a job whose first attempts are killed; return its address and itself.

    A tiny lift may end before it is seen to run: then another is ordered.
    """
    while True:
        job = server.client.post("/lift", json=order).headers["location"]
        record = kill_attempts(server, job, count)
        if record["attempt"] >= min(count + 1, ATTEMPTS):
            return job, record
        delete_lift(server.client, job.removeprefix("/jobs/"))


def test_killed_or_stopped_server_finishes_each_job_once_with_the_same_digest(
    server: Server, order: dict[str, Any], lift: dict[str, Any], tiny: TinyScene
) -> None:
    client, undisturbed = server.client, digest_of_lift(server.client, lift["links"]["self"])

    def order_job(key: str) -> httpx.Response:
        return client.post("/lift", json=order, headers={"Idempotency-Key": key})

    before = {entry["id"] for entry in client.get("/lifts").json()["lifts"]}
    jobs = [order_job("0").headers["location"]]
    for number, status in ((signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 0)):
        wait_for_end(client, jobs[0], "running")
        if number == signal.SIGKILL:
            jobs.append(order_job("1").headers["location"])  # at once before
        assert server.end(number) == status
        until(lambda: not server.processes())  # its children end with it
        server.start()
    for key, job in enumerate(jobs):
        record = wait_for_end(client, job)
        assert (record["state"], record["attempt"]) == ("succeeded", 1)  # faults of the server do not count
        assert order_job(str(key)).headers["location"] == job
        assert times_succeeded(client, job) == 1
        assert digest_of_lift(client, record["links"]["lift"]) == undisturbed
    ids = {job.removeprefix("/jobs/") for job in jobs}
    assert {entry["id"] for entry in client.get("/lifts").json()["lifts"]} == before | ids
    assert client.get(f"/assets/{order['splats']}/content").content == tiny.splats
    for job in ids:
        delete_lift(client, job)


def test_job_whose_process_is_killed_goes_on_until_its_third_attempt(server: Server, order: dict[str, Any]) -> None:
    client = server.client
    once, _ = job_killed(server, order, 1)
    assert (wait_for_end(client, once)["state"], times_succeeded(client, once)) == ("succeeded", 1)
    delete_lift(client, once.removeprefix("/jobs/"))
    always, record = job_killed(server, order, ATTEMPTS)
    assert (record["state"], record["attempt"]) == ("failed", ATTEMPTS)
    assert record["problem"]["type"] == "/problems/crashed" and record["problem"]["detail"]
    assert_problem(client.get(f"/lifts/{record['id']}"), 404)
    assert client.delete(always).status_code == 204
    until(lambda: client.get("/readyz").status_code == 200)  # for the tests that share the server
