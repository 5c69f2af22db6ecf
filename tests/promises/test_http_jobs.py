"""Jobs over HTTP: ordered once, followed, canceled, failed with reasons; plans and trade-offs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest

from tests.server import Server, until, wait_for_end
from tests.tiny_scene import TinyScene, cameras_document, labels, masks

from .over_http import NO_ASSET, assert_problem, delete_lift, events_of, upload

LONG_BUDGET_S = 600  # of a trade-off, which runs for as long as somebody is to cancel it


def order_job(client: httpx.Client, body: dict[str, Any], key: str | None = None, route: str = "/lift") -> Any:
    return client.post(route, json=body, headers={} if key is None else {"Idempotency-Key": key})


@pytest.fixture
def busy(server: Server, order: dict[str, Any]) -> Iterator[str]:
    """The path of a job that keeps all others waiting."""
    reply = order_job(server.client, order | {"budget_s": LONG_BUDGET_S}, route="/tradeoff")
    assert reply.status_code == 202, reply.text
    path = reply.headers["location"]
    until(lambda: server.client.get(path).json()["state"] == "running")
    yield path
    server.client.post(f"{path}/cancel")
    assert wait_for_end(server.client, path)["state"] == "canceled"
    assert server.client.delete(path).status_code == 204


# While a job runs


def test_order_is_a_job_at_once_repeated_the_same_one_and_refused_in_a_full_line(
    client: httpx.Client, order: dict[str, Any], busy: str
) -> None:
    del busy
    first, second = (order_job(client, order, "one") for _ in range(2))
    assert (first.status_code, second.status_code) == (202, 200)
    job = first.json()
    assert first.headers["location"] == second.headers["location"] == f"/jobs/{job['id']}" == job["links"]["self"]
    assert client.get(first.headers["location"]).json() == second.json()
    assert (job["kind"], job["state"], job["problem"], job["settings"]["preset"]) == (
        "lift",
        "queued",
        None,
        "row-sum",
    )
    assert [job[name] for name in ("splats", "cameras", "features")] == [*order.values()][:3]
    other = order_job(client, order, "two").json()
    keyless = [order_job(client, order).json()["id"] for _ in range(2)]
    assert len({job["id"], other["id"], *keyless}) == 4
    changes = order_job(client, order | {"settings": {"preset": "tikhonov"}}, "one")
    assert assert_problem(changes, 422)["type"] == "/problems/key-reused"
    assert_problem(order_job(client, order | {"budget_s": 60}, "one", route="/tradeoff"), 422)
    for key in ("", "x" * 256):
        assert_problem(order_job(client, order, key), 422)
    last = [order_job(client, order) for _ in range(3)]
    assert [reply.status_code for reply in last] == [202, 202, 503]  # the line is full
    assert_problem(last[-1], 503)
    assert int(last[-1].headers["retry-after"]) > 0
    assert order_job(client, order, "one").status_code == 200
    for identifier in (job["id"], other["id"], *keyless, *(reply.json()["id"] for reply in last[:-1])):
        assert client.post(f"/jobs/{identifier}/cancel").json()["state"] == "canceled"
        assert client.delete(f"/jobs/{identifier}").status_code == 204


def test_queued_job_is_canceled_at_once_and_can_be_deleted(
    client: httpx.Client, order: dict[str, Any], busy: str
) -> None:
    assert busy in [job["links"]["self"] for job in client.get("/jobs").json()["jobs"]]
    path = order_job(client, order).headers["location"]
    for job in (path, busy):
        assert_problem(client.delete(job), 409)
    for _ in range(2):  # again does no harm
        reply = client.post(f"{path}/cancel")
        assert (reply.status_code, reply.json()["state"], reply.json()["attempt"]) == (200, "canceled", 0)
    states = [data["state"] for _, name, data in events_of(client.get(f"{path}/events").text) if name == "state"]
    assert states == ["queued", "canceled"]
    assert client.delete(path).status_code == 204
    for reply in (client.get(path), client.delete(path), client.get(f"{path}/events"), client.post(f"{path}/cancel")):
        assert_problem(reply, 404)


def test_canceled_job_has_ended_with_all_its_processes(server: Server, order: dict[str, Any]) -> None:
    idle = len(server.processes())
    body = order | {"budget_s": LONG_BUDGET_S}
    path = order_job(server.client, body, route="/tradeoff").headers["location"]
    until(lambda: server.client.get(path).json()["state"] == "running" and len(server.processes()) > idle)
    reply = server.client.post(f"{path}/cancel")
    assert reply.status_code in (200, 202) and reply.json()["state"] in ("canceling", "canceled")
    job = wait_for_end(server.client, path)
    assert len(server.processes()) <= idle  # canceled means that none of it is left
    assert (job["state"], job["problem"]) == ("canceled", None) and job["ended"] >= job["started"]
    assert server.client.post(f"{path}/cancel").json()["state"] == "canceled"
    assert server.client.delete(path).status_code == 204


# What a job becomes


def test_events_tell_the_whole_story_and_go_on_after_the_last(client: httpx.Client, lift: dict[str, Any]) -> None:
    path = f"{lift['links']['job']}/events"
    reply = client.get(path)
    assert reply.headers["content-type"].startswith("text/event-stream")
    story = list(events_of(reply.text))
    numbers = [number for number, _, _ in story]
    assert numbers == sorted(set(numbers))
    assert [data["state"] for _, name, data in story if name == "state"] == ["queued", "running", "succeeded"]
    assert story[-1][1] == "state" and {name for _, name, _ in story} >= {"state", "plan"}
    (plan,) = [data for _, name, data in story if name == "plan"]
    assert plan == client.get(lift["links"]["job"]).json()["plan"]
    later = list(events_of(client.get(path, headers={"Last-Event-ID": str(numbers[2])}).text))
    assert later == story[3:]
    assert client.get(path, headers={"Last-Event-ID": str(numbers[-1])}).status_code == 204


def test_succeeded_job_tells_its_plan_its_times_and_its_lift(client: httpx.Client, lift: dict[str, Any]) -> None:
    job = client.get(lift["links"]["job"]).json()
    assert (job["id"], job["state"], job["attempt"], job["problem"]) == (lift["id"], "succeeded", 1, None)
    assert job["created"] <= job["started"] <= job["ended"]
    assert job["plan"]["summary"][0].startswith("60 splats") and job["plan"]["splats"] == 60
    assert job["progress"]["completed"] == job["progress"]["total"] and job["progress"]["unit"]
    assert job in client.get("/jobs").json()["jobs"]
    assert_problem(client.post(f"{job['links']['self']}/cancel"), 409)
    assert_problem(client.delete(job["links"]["self"]), 409)  # its lift is somebody's work
    assert client.get(lift["links"]["self"]).json() == lift


def test_failed_job_says_why_as_a_problem(client: httpx.Client, order: dict[str, Any]) -> None:
    reply = order_job(client, order | {"settings": {"kernel": "dbs"}})  # for which these splats lack a property
    job = wait_for_end(client, reply.headers["location"])
    problem = job["problem"]
    assert (job["state"], job["attempt"]) == ("failed", 1), job
    *_, (_, name, last) = events_of(client.get(job["links"]["events"]).text)
    assert (name, last["state"], last["problem"]) == ("state", "failed", problem)
    assert client.delete(job["links"]["self"]).status_code == 204
    assert problem["type"].startswith("/problems/") and problem["status"] == 422, problem
    assert problem["argument"] and problem["expected"] and problem["got"]
    assert "/tmp" not in json.dumps(problem)


def test_job_and_lift_keep_what_the_plan_warned_of(client: httpx.Client, order: dict[str, Any]) -> None:
    away = cameras_document()
    for frame in away["frames"]:  # they look the other way
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1, -1, 1])).tolist()
    cameras = upload(client, "cameras", json.dumps(away).encode())
    body = order | {"cameras": cameras}
    before = client.get("/jobs").json()
    plan = client.post("/lift/plan", json=body).json()
    assert (plan["splats"], plan["views"], plan["channels"]) == (60, 3, 8) and plan["memory_bytes"] > 0
    assert client.get("/jobs").json() == before  # a plan is no job
    warnings = plan["warnings"]
    assert any("no camera can see" in line for line in warnings)
    path = order_job(client, body).headers["location"]
    story = list(events_of(client.get(f"{path}/events").text))  # which returns when the stream ends, with the job
    job = client.get(path).json()
    assert story[-1][2]["state"] == job["state"] == "succeeded", job
    assert set(warnings) <= set(job["plan"]["warnings"])
    kept_state = client.get(job["links"]["lift"]).json()["diagnostics"]["warnings"]
    assert any("no camera can see" in line for line in kept_state)
    delete_lift(client, job["id"])
    assert client.delete(f"/assets/{cameras}").status_code == 204


LIFTS, TRADEOFFS = ("/lift", "/lift/plan"), ("/tradeoff",)
BAD_ORDERS: dict[str, tuple[tuple[str, ...], dict[str, Any], int, str]] = {
    "an unknown preset": (LIFTS, {"settings": {"preset": "magic"}}, 422, "preset"),
    "a setting out of bounds": (LIFTS, {"settings": {"power": 3}}, 422, "power"),
    "an unknown asset": (LIFTS, {"splats": NO_ASSET}, 404, "splats"),
    "no features": (LIFTS, {"features": []}, 422, "features"),
    "an unknown field": (LIFTS, {"extra": 1}, 422, "extra"),
    "no time": (TRADEOFFS, {"budget_s": 0}, 422, "budget_s"),
    "a setting that is compared": (TRADEOFFS, {"settings": {"quality": "fast"}}, 422, "quality"),
    "no classes": (TRADEOFFS, {"labels": {"masks": NO_ASSET, "table": NO_ASSET, "classes": []}}, 422, "labels"),
}


@pytest.mark.parametrize("name", BAD_ORDERS)
def test_bad_order_names_its_field_and_is_no_job(client: httpx.Client, order: dict[str, Any], name: str) -> None:
    routes, change, status, argument = BAD_ORDERS[name]
    before = client.get("/jobs").json()
    for route in routes:
        problem = assert_problem(client.post(route, json=order | change), status)
        assert argument in problem["argument"] and problem["expected"] and problem["got"]
    assert client.get("/jobs").json() == before


def test_asset_in_a_wrong_place_is_refused(client: httpx.Client, order: dict[str, Any]) -> None:
    problem = assert_problem(order_job(client, order | {"splats": order["cameras"]}))
    assert problem["status"] in (404, 422) and "cameras" in problem["detail"]


# Trade-offs


def test_tradeoff_is_judged_by_the_masks_of_its_order(
    client: httpx.Client, order: dict[str, Any], tiny: TinyScene
) -> None:
    masks_of_right = masks({"right": 2 - labels()["right"][0]})  # numbers of the classes below
    verdict = {
        "masks": upload(client, "masks", masks_of_right),
        "table": upload(client, "table", replace(tiny).table),
        "classes": ["lamp", "book", "apple"],
    }
    body = order | {"settings": {"diagnostic_rays": 0, "preset": "tikhonov"}, "budget_s": 10, "labels": verdict}
    first, second = (order_job(client, body, "judged", route="/tradeoff") for _ in range(2))
    assert (first.status_code, second.status_code, first.json()["kind"]) == (202, 200, "tradeoff")
    job = wait_for_end(client, first.headers["location"])
    assert (job["state"], job["problem"]) == ("succeeded", None), job
    tradeoff = client.get(job["links"]["tradeoff"]).json()
    exact = tradeoff["runs"][0]
    assert exact["settings"]["preset"] == "tikhonov" and exact["mask_iou"] > 0.5 and tradeoff["seconds"] > 0
    assert tradeoff["choice"]["name"] in {run["name"] for run in tradeoff["runs"]}
    assert tradeoff["labels"] == verdict and "/tmp" not in json.dumps(tradeoff)
    assert client.get(job["links"]["chart"]).content.startswith(b"\x89PNG")
    assert job["id"] not in {entry["id"] for entry in client.get("/lifts").json()["lifts"]}
    assert_problem(client.delete(job["links"]["self"]), 409)
    assert client.delete(job["links"]["self"], params={"with_tradeoff": True}).status_code == 204
    for link in job["links"].values():
        assert_problem(client.get(link), 404)
    for asset in (verdict["masks"], verdict["table"]):
        assert client.delete(f"/assets/{asset}").status_code == 204
