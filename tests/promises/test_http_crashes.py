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

from .over_http import assert_problem, events_of, upload, upload_scene

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


def test_killed_server_finishes_each_job_once_with_the_same_digest(
    start: Callable[..., Server], tiny: TinyScene
) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        undisturbed = server.client.post("/lift", json=body).headers["location"]
        assert wait_for_end(server.client, undisturbed)["state"] == "succeeded"
        jobs = {}
        for key in ("first", "second"):
            reply = server.client.post("/lift", json=body, headers={"Idempotency-Key": key})
            jobs[key] = reply.headers["location"]
        until(lambda: state_of(server, jobs["first"]) == "running")
        for _ in range(4):  # more often than a job has attempts: a fault of the server is none of its
            server.kill()
            until(lambda: not server.processes())  # its children end with it
            server.start()
            until(lambda: state_of(server, jobs["first"]) in ("running", *FINAL_STATES))
        for key, job in jobs.items():
            assert wait_for_end(server.client, job)["state"] == "succeeded"
            again = server.client.post("/lift", json=body, headers={"Idempotency-Key": key})
            assert (again.status_code, again.headers["location"]) == (200, job)
            assert times_succeeded(server, job) == 1
        lifts = [entry["links"]["self"] for entry in server.client.get("/lifts").json()["lifts"]]
        assert len(lifts) == 3 == len({entry["id"] for entry in server.client.get("/jobs").json()["jobs"]})
        assert len({digest_of_lift(server.client, lift) for lift in lifts}) == 1
        assert server.client.get("/query", params={"lift": lifts[0][-32:], "text": "lamp"}).json()["count"] == 20


def test_order_that_was_acknowledged_outlives_a_kill(start: Callable[..., Server], tiny: TinyScene) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        for number in range(3):
            job = server.client.post("/lift", json=body, headers={"Idempotency-Key": str(number)})
            server.kill()
            server.start()
            assert job.status_code == 202
            again = server.client.post("/lift", json=body, headers={"Idempotency-Key": str(number)})
            assert (again.status_code, again.json()["id"]) == (200, job.json()["id"])
        for kind, asset in (("splats", body["splats"]), ("cameras", body["cameras"])):
            assert server.client.get(f"/assets/{asset}/content").content == getattr(tiny, kind)


def test_job_whose_process_is_killed_goes_on_until_its_third_attempt(
    start: Callable[..., Server], tiny: TinyScene
) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        once, always = (server.client.post("/lift", json=body).headers["location"] for _ in range(2))

        def kill_attempt(job: str, attempt: int) -> dict[str, Any]:
            """Kill what runs until the attempt at a job is over."""

            def over() -> dict[str, Any] | None:
                record = server.client.get(job).json()
                if record["state"] in FINAL_STATES or record["attempt"] > attempt:
                    return record
                if record["state"] == "running":
                    server.kill_children()
                    time.sleep(0.1)
                return None

            return until(over)

        assert kill_attempt(once, 1)["attempt"] == 2
        record = wait_for_end(server.client, once)
        assert (record["state"], times_succeeded(server, once)) == ("succeeded", 1)
        record = kill_attempt(always, 3)
        assert (record["state"], record["attempt"]) == ("failed", 3)
        assert record["problem"]["type"] == "/problems/crashed" and record["problem"]["detail"]
        assert server.client.get(f"/lifts/{record['id']}").status_code == 404
        upload(server.client, "table", tiny.table)  # a check works again
        assert server.client.get("/query", params={"text": "lamp"}).json()["count"] == 20
        assert server.is_alive()


def test_stopped_server_exits_with_0_and_its_job_goes_on_later(start: Callable[..., Server], tiny: TinyScene) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        job = server.client.post("/lift", json=body).headers["location"]
        until(lambda: state_of(server, job) == "running")
        assert server.stop() == 0
        until(lambda: not server.processes())
        server.start()
        assert wait_for_end(server.client, job)["state"] == "succeeded"


def test_server_whose_question_is_killed_answers_the_next(start: Callable[..., Server], tiny: TinyScene) -> None:
    with start() as server:
        body = upload_scene(server.client, tiny)
        job = server.client.post("/lift", json=body).headers["location"]
        assert wait_for_end(server.client, job)["state"] == "succeeded"
        question = {"text": "lamp", "threshold": 0.5}
        answer = server.client.get("/query", params=question).json()
        server.kill_children()

        def answered() -> httpx.Response | None:
            reply = server.client.get("/query", params=question)
            return reply if reply.status_code == 200 else None

        assert until(answered).json() == answer
        asset = server.client.put("/assets/cameras", content=b"{")
        assert_problem(asset, 422)
