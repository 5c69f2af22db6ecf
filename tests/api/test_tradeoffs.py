"""Trade-offs over HTTP: ordered as jobs, looked at, deleted, judged by masks; and one that is real."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.models import AssetKind
from service.store.jobs import fingerprint
from service.store.store import Store
from tests.crash.conftest import labels as stored_labels
from tests.crash.conftest import until
from tests.crash.service_process import processes_of
from tests.server import wait_for_end
from tests.tiny_scene import TinyScene, labels, masks, text_table

from .conftest import SceneAssets, parts_of, put
from .test_jobs import Quick, quick
from .test_problems import NO_ASSET, assert_problem

__all__ = ["quick"]  # a fixture

CLASSES = ["the Lamp", "book", "apple"]  # in another order than the table has them
MASKS = {view: 2 - label_map[0] for view, label_map in labels().items()}  # numbers of these classes


def compare(client: TestClient, body: dict[str, Any], **extra: Any) -> Any:
    return client.post("/tradeoff", json=body | extra, headers={"Idempotency-Key": "one"})


def test_tradeoff_is_a_job_as_a_lift_is(quick: Quick) -> None:
    with quick("answer") as (client, body):
        first, second = (compare(client, body, budget_s=60) for _ in range(2))
        assert (first.status_code, second.status_code) == (202, 200)
        assert first.json()["id"] == second.json()["id"]
        assert (first.json()["kind"], first.json()["parameters"]) == ("tradeoff", {"budget_s": 60})
        assert assert_problem(compare(client, body, budget_s=61))["type"] == "/problems/key-reused"
        lift = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert assert_problem(lift)["type"] == "/problems/key-reused"
        job = wait_for_end(client, first.headers["location"])
        assert (job["state"], job["problem"]) == ("succeeded", None)
        assert set(job["links"]) == {"self", "events", "tradeoff", "chart"}
        lifted = client.post("/lift", json=body).json()
        assert lifted["kind"] == "lift" and lifted["parameters"] == {}
        assert {tradeoff["kind"] for tradeoff in client.get("/jobs").json()["jobs"]} == {"lift", "tradeoff"}


def test_what_was_found_is_no_lift_and_goes_when_that_is_said(quick: Quick) -> None:
    with quick("answer") as (client, body):
        links = wait_for_end(client, compare(client, body, budget_s=60).headers["location"])["links"]
        tradeoff = client.get(links["tradeoff"])
        assert tradeoff.status_code == 200 and tradeoff.json()["budget_s"] == 60
        assert [tradeoff.json()[name] for name in ("splats", "cameras", "features")] == [*body.values()]
        assert tradeoff.json()["labels"] is None
        for link in tradeoff.json()["links"].values():
            assert client.get(link).status_code == 200, link
        chart = client.get(links["chart"])
        assert (chart.content, chart.headers["content-type"]) == (b"a chart", "image/png")
        tag = {"If-None-Match": chart.headers["etag"]}
        assert client.get(links["chart"], headers=tag).status_code == 304
        assert client.get(tradeoff.json()["links"]["table"]).text == "a table"
        job = tradeoff.json()["id"]
        assert client.get("/lifts").json()["lifts"] == []
        lift = wait_for_end(client, client.post("/lift", json=body).headers["location"])["id"]
        for path in (f"/lifts/{job}", f"/lifts/{job}/features", f"/tradeoffs/{lift}", f"/tradeoffs/{lift}/chart"):
            assert assert_problem(client.get(path))["type"] == "/problems/not-found"
        for params in ({}, {"with_lift": True}):
            reply = client.delete(links["self"], params=params)
            assert assert_problem(reply)["status"] == 409 and "with_tradeoff=true" in reply.json()["hint"]
        assert client.get(links["chart"]).status_code == 200
        assert client.delete(links["self"], params={"with_tradeoff": True}).status_code == 204
        for link in links.values():
            assert assert_problem(client.get(link))["status"] == 404


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"budget_s": 9}, "budget_s"),
        ({"budget_s": 3601}, "at most 3600 s"),
        ({"budget_s": math.nan}, "budget_s"),
        ({"budget_s": math.inf}, "budget_s"),
        ({"settings": {"quality": "fast"}}, "the same in all runs"),
        ({"settings": {"speed": "fast"}}, "the same in all runs"),
        ({"settings": {"stride": 0}}, "stride"),
        ({"labels": "x"}, "labels"),
        ({"splats": "sha256:" + hashlib.sha256(b"cameras").hexdigest()}, "splats"),
    ],
)
def test_bad_order_is_a_problem_that_names_what_is_wrong(quick: Quick, wrong: dict[str, Any], message: str) -> None:
    with quick("answer") as (client, body):
        content = json.dumps(body | wrong)
        reply = client.post("/tradeoff", content=content, headers={"Content-Type": "application/json"})
        problem = assert_problem(reply)
        assert problem["status"] == (404 if message == "splats" else 422) and message in problem["detail"]
        assert client.get("/jobs").json()["jobs"] == []


def test_room_for_the_exact_features_is_asked_for_beforehand(
    client: TestClient, scene_assets: SceneAssets, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage, floor = shutil.disk_usage("/"), parts_of(client).store.files.floor_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=floor + 60 * 9 * 2 - 1))
    reply = client.post("/tradeoff", json=scene_assets.order() | {"budget_s": 10})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/no-space", 507)


def test_real_tradeoff_is_judged_by_the_masks_of_its_order(
    client: TestClient, scene_assets: SceneAssets, masked_order: dict[str, Any]
) -> None:
    order = scene_assets.order(diagnostic_rays=0, preset="tikhonov") | {"budget_s": 10, "labels": masked_order}
    job = wait_for_end(client, client.post("/tradeoff", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    assert job["parameters"] == {"budget_s": 10, "labels": masked_order}
    assert job["progress"]["stage"] == "tradeoff" and job["progress"]["completed"] == job["progress"]["total"]
    tradeoff = client.get(job["links"]["tradeoff"]).json()
    exact = tradeoff["runs"][0]
    assert exact["name"] == "exact" and exact["cosine"] == pytest.approx(1.0) and exact["mask_iou"] > 0.5
    assert exact["settings"]["preset"] == "tikhonov"  # where the levels of quality begin
    assert all(run["settings"]["diagnostic_rays"] == 0 for run in tradeoff["runs"])
    assert (tradeoff["labelled_views"], tradeoff["labels"], tradeoff["choice"]["accuracy"]) == (
        1,
        masked_order,
        "mask_iou",
    )
    assert tradeoff["choice"]["name"] in {run["name"] for run in tradeoff["runs"]}
    assert not tradeoff["choice"]["recommended"]  # by the one view that is held out
    assert str(parts_of(client).store.files.root) not in json.dumps(tradeoff)  # no path of this machine
    table = client.get(tradeoff["links"]["table"]).text
    assert "Nothing can be recommended" in table
    assert f"{exact['mask_iou']:.4f}" in table and masked_order["masks"] in table
    assert client.get(job["links"]["chart"]).content.startswith(b"\x89PNG")
    assert client.delete(job["links"]["self"], params={"with_tradeoff": True}).status_code == 204


def test_canceled_tradeoff_leaves_no_process_of_its_runs(client: TestClient, scene_assets: SceneAssets) -> None:
    body = scene_assets.order(diagnostic_rays=0) | {"budget_s": 600}
    job = client.post("/tradeoff", json=body).json()["id"]
    until(lambda: len(processes_of(job)) == 2)  # the job's process, and a run's
    client.post(f"/jobs/{job}/cancel")
    assert wait_for_end(client, f"/jobs/{job}")["state"] == "canceled"
    assert processes_of(job) == []
    assert client.delete(f"/jobs/{job}").status_code == 204


@pytest.fixture(scope="module")
def masked_order(client: TestClient, scene_assets: SceneAssets, scene: TinyScene) -> Iterator[dict[str, Any]]:
    """The labels of an order: masks of one view, and the table."""
    files = {"masks": masks({"right": MASKS["right"], "nowhere": MASKS["left"]}), "table": scene.table}
    ids = {kind: put(client, AssetKind(kind), content) for kind, content in files.items()}
    counts = {kind: client.get(f"/assets/{asset}").json()["counts"] for kind, asset in ids.items()}
    assert (counts["masks"]["names"], counts["masks"]["classes"]) == (["nowhere", "right"], 3)
    assert (counts["table"]["channels"], counts["table"]["words"]) == (8, ["apple", "book", "lamp"])
    yield {**ids, "classes": CLASSES}
    for asset in ids.values():
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_labels_that_do_not_fit_are_refused_at_once(
    client: TestClient, scene_assets: SceneAssets, masked_order: dict[str, Any]
) -> None:
    contents = [masks({"nowhere": MASKS["left"]}), masks(MASKS), masks({"left": MASKS["left"]})]
    other_size, all_views, first = (put(client, AssetKind.MASKS, content) for content in contents)
    narrow = put(client, AssetKind.TABLE, text_table(5))
    before = client.get("/jobs").json()
    for wrong, argument, message in (
        ({"classes": ["lamp", "bok", "apple"]}, "labels.classes.1", "nearest: book"),
        ({"classes": ["lamp", "book", "The_Book"]}, "labels.classes", "each class once"),
        ({"classes": ["lamp", "book"]}, "labels.classes", "classes 0..2"),
        ({"classes": []}, "labels.classes", "at least 1 item"),
        ({"classes": ["\ud800", "book", "apple"]}, "labels.classes.0", ""),
        ({"table": "words.safetensors"}, "labels.table", "sha256"),
        ({"table": narrow}, "labels.table", "8 channels"),
        ({"masks": other_size}, "labels.masks", "none in common"),
        ({"masks": all_views}, "labels.masks", "masks of all of them"),
        ({"masks": first}, "labels.masks", "masks of all of them"),  # of all that this stride takes
        ({"masks": NO_ASSET}, "masks", NO_ASSET),
        ({"masks": scene_assets.features}, "masks", "features"),
        ({"table": scene_assets.features}, "table", "features"),
    ):
        stride = {"view_stride": 3} if wrong == {"masks": first} else {}
        body = json.dumps(scene_assets.order(**stride) | {"labels": masked_order | wrong})
        reply = client.post("/tradeoff", content=body, headers={"Content-Type": "application/json"})
        problem = assert_problem(reply)
        assert problem["status"] == (422 if argument.startswith("labels") else 404), wrong
        assert problem["argument"] == argument and message in problem["detail"], wrong
    assert client.get("/jobs").json() == before
    for asset in (other_size, all_views, first, narrow):
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_order_with_other_labels_is_another_order_and_one_without_is_what_it_was(quick: Quick, store: Store) -> None:
    with quick("answer") as (client, body):
        stored, key = stored_labels(store), {"Idempotency-Key": "one"}
        first, second = (client.post("/tradeoff", json=body | {"labels": stored}, headers=key) for _ in range(2))
        assert (first.status_code, second.status_code) == (202, 200) and first.json()["id"] == second.json()["id"]
        for other in (body, body | {"labels": stored | {"classes": ["Apple"]}}):
            assert assert_problem(client.post("/tradeoff", json=other, headers=key))["type"] == "/problems/key-reused"
        without_labels = client.post("/tradeoff", json=body, headers={"Idempotency-Key": "two"}).json()["id"]
        with store.database.read() as connection:
            row = connection.execute("SELECT fingerprint FROM jobs WHERE id = ?", (without_labels,)).fetchone()
    assert row["fingerprint"] == fingerprint(body | {"settings": {}, "budget_s": 600.0})  # of the release before
