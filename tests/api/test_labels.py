"""Trade-offs that are judged by masks: their figures, what is refused, and what stays."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.evaluate.ranking import accuracy_of
from liftcore.evaluate.tradeoff import RunSpec, Scene, measured
from service.models import AssetKind, JobKind
from service.store.jobs import fingerprint
from service.store.owners import Owner
from service.store.store import Store
from tests.crash.conftest import labels as stored_labels
from tests.crash.conftest import order

from .conftest import Uploaded, put
from .following import ended
from .test_jobs import Quick, quick
from .test_problems import NO_ASSET, assert_problem
from .tiny_scene import TinyScene, labels, masks, text_table

__all__ = ["quick"]  # a fixture

CLASSES = ["the Lamp", "book", "apple"]  # in another order than the table has them
MASKS = {view: 2 - found[0] for view, found in labels().items()}  # numbers of these classes


@pytest.fixture(scope="module")
def judged(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> Iterator[dict[str, Any]]:
    """The labels of an order: masks of one view, and the table."""
    files = {"masks": masks({"right": MASKS["right"], "nowhere": MASKS["left"]}), "table": scene.table}
    ids = {kind: put(client, AssetKind(kind), content) for kind, content in files.items()}
    yield {**ids, "classes": CLASSES}
    for asset in ids.values():
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_masks_and_tables_tell_what_orders_are_held_to(client: TestClient, judged: dict[str, Any]) -> None:
    counts = client.get(f"/assets/{judged['masks']}").json()["counts"]
    assert (counts["views"], counts["names"], counts["classes"]) == (2, ["nowhere", "right"], 3)
    counts = client.get(f"/assets/{judged['table']}").json()["counts"]
    assert (counts["rows"], counts["channels"], counts["words"]) == (3, 8, ["apple", "book", "lamp"])


def test_masks_judge_over_http_as_they_do_on_the_command_line(
    client: TestClient, uploaded: Uploaded, scene: TinyScene, judged: dict[str, Any], tmp_path: Path
) -> None:
    body = uploaded.order(certificate_rays=0) | {"budget_s": 10, "labels": judged}
    job = ended(client, client.post("/tradeoff", json=body).headers["location"])
    assert job["state"] == "succeeded", job
    assert job["parameters"] == {"budget_s": 10, "labels": judged}
    found = client.get(job["links"]["tradeoff"]).json()
    for name in ("splats", "cameras", "features", "table"):
        (tmp_path / name).write_bytes(getattr(scene, name))
    (tmp_path / "masks").write_bytes(client.get(f"/assets/{judged['masks']}/content").content)
    files = Scene(
        tmp_path / "splats", tmp_path / "cameras", (tmp_path / "features",), tmp_path / "masks", tmp_path / "table",
        tuple(CLASSES),
    )  # fmt: skip
    settings = {"certificate_rays": 0, "speed": "exact"}
    exact = measured(RunSpec(files, settings, ("left",), ("middle",), ("right",), 1, tmp_path, exact=True))
    exact |= accuracy_of(exact["judged"])
    assert exact["mask_iou"] > 0.5
    run = found["runs"][0]
    assert (run["name"], run["mask_iou"]) == ("exact", exact["mask_iou"])
    assert (run["centred_cosine"], run["phrase_iou"]) == (exact["centred_cosine"], exact["phrase_iou"])
    assert found["labelled_views"] == 1
    assert (found["labels"], found["choice"]["accuracy"]) == (judged, "mask_iou")
    table = client.get(found["links"]["table"]).text
    assert f"{exact['mask_iou']:.4f}" in table and judged["masks"] in table
    assert client.get(job["links"]["chart"]).content.startswith(b"\x89PNG")
    assert client.delete(job["links"]["self"], params={"with_tradeoff": True}).status_code == 204


@pytest.mark.parametrize(
    ("wrong", "argument", "told"),
    [
        ({"classes": ["lamp", "bok", "apple"]}, "labels.classes.1", "nearest: book"),
        ({"classes": ["lamp", "book", "The_Book"]}, "labels.classes", "each class once"),
        ({"classes": ["lamp", "book"]}, "labels.classes", "classes 0..2"),
        ({"classes": []}, "labels.classes", "at least 1 item"),
        ({"classes": ["\ud800", "book", "apple"]}, "labels.classes.0", ""),
        ({"classes": None}, "labels.classes", "valid list"),
        ({"table": "words.safetensors"}, "labels.table", "sha256"),
        ({"words": ["lamp"]}, "labels.words", "one of masks, table, classes"),
    ],
)
def test_labels_that_do_not_fit_are_refused_at_once(
    client: TestClient, uploaded: Uploaded, judged: dict[str, Any], wrong: dict[str, Any], argument: str, told: str
) -> None:
    problem = refused(client, uploaded, judged | wrong)
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-request")
    assert problem["argument"] == argument and told in problem["detail"]


def test_files_that_do_not_fit_are_refused_at_once(
    client: TestClient, uploaded: Uploaded, judged: dict[str, Any]
) -> None:
    files = [
        ("masks", masks({"nowhere": MASKS["left"]}), "none in common"),
        ("masks", masks(MASKS), "masks of all of them"),
        ("table", text_table(5), "8 channels"),
    ]
    for kind, content, told in files:
        asset = put(client, AssetKind(kind), content)
        problem = refused(client, uploaded, judged | {kind: asset})
        assert (problem["status"], problem["argument"]) == (422, f"labels.{kind}") and told in problem["detail"]
        assert client.delete(f"/assets/{asset}").status_code == 204
    # Of every second view, "left" and "right", masks leave one to lift; of every third, "left", they may leave none.
    asset = put(client, AssetKind.MASKS, masks({"left": MASKS["left"]}))
    body = {"labels": judged | {"masks": asset}, "settings": {"view_stride": 3}}
    problem = assert_problem(client.post("/tradeoff", json=uploaded.order() | body))
    assert (problem["status"], problem["argument"]) == (422, "labels.masks")
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_labels_that_are_not_here_or_of_another_kind_are_not_found(
    client: TestClient, uploaded: Uploaded, judged: dict[str, Any]
) -> None:
    for kind in ("masks", "table"):
        for asset in (NO_ASSET, uploaded.features):
            problem = refused(client, uploaded, judged | {kind: asset})
            assert (problem["status"], problem["argument"]) == (404, kind)


def refused(client: TestClient, uploaded: Uploaded, given: dict[str, Any]) -> dict[str, Any]:
    before = client.get("/jobs").json()
    body = json.dumps(uploaded.order() | {"labels": given})  # httpx would not send half a surrogate pair
    reply = client.post("/tradeoff", content=body, headers={"Content-Type": "application/json"})
    problem = assert_problem(reply)
    assert client.get("/jobs").json() == before
    return problem


def test_masks_and_table_stay_as_long_as_a_job_names_them(quick: Quick, store: Store) -> None:
    with quick("hang") as (client, body):
        given = stored_labels(store)
        jobs = [client.post("/tradeoff", json=body | {"labels": given}).json()["id"] for _ in range(2)]
        for job in jobs:  # one runs and one waits, then none does
            for asset in (given["masks"], given["table"]):
                problem = assert_problem(client.delete(f"/assets/{asset}"))
                assert (problem["status"], problem["type"]) == (409, "/problems/in-use") and job in problem["hint"]
            client.post(f"/jobs/{job}/cancel")
            assert ended(client, f"/jobs/{job}")["state"] == "canceled"
            assert client.delete(f"/jobs/{job}").status_code == 204
        for asset in (given["masks"], given["table"]):
            assert client.delete(f"/assets/{asset}").status_code == 204


def test_job_whose_process_died_is_judged_by_the_same_labels(quick: Quick, store: Store) -> None:
    with quick("die_once") as (client, body):
        given = stored_labels(store)
        job = ended(client, client.post("/tradeoff", json=body | {"labels": given}).headers["location"])
        assert (job["state"], job["attempt"], job["parameters"]["labels"]) == ("succeeded", 2, given)
        assert client.get(job["links"]["tradeoff"]).json()["labels"] == given


def test_order_with_other_labels_is_another_order_and_one_without_is_what_it_was(quick: Quick, store: Store) -> None:
    with quick("answer") as (client, body):
        given, key = stored_labels(store), {"Idempotency-Key": "one"}
        first, again = (client.post("/tradeoff", json=body | {"labels": given}, headers=key) for _ in range(2))
        assert (first.status_code, again.status_code) == (202, 200) and first.json()["id"] == again.json()["id"]
        for other in (body, body | {"labels": given | {"classes": ["Apple"]}}):
            assert assert_problem(client.post("/tradeoff", json=other, headers=key))["type"] == "/problems/key-reused"
        plain = client.post("/tradeoff", json=body, headers={"Idempotency-Key": "two"}).json()["id"]
        with store.database.read() as connection:
            row = connection.execute("SELECT fingerprint FROM jobs WHERE id = ?", (plain,)).fetchone()
    assert row["fingerprint"] == fingerprint(body | {"settings": {}, "budget_s": 600.0})  # of the release before


def test_labels_of_another_owner_are_not_found_and_an_admins_job_keeps_them(store: Store) -> None:
    anna, admin = Owner("a", sees_all=False), Owner("admin", sees_all=True)
    given = stored_labels(store, anna)
    known = order(store, anna)
    for kind in ("masks", "table"):
        assert store.assets.find(Owner("b", sees_all=False), given[kind]) is None
    job = store.jobs.submit(admin, replace(known, kind=JobKind.TRADEOFF, parameters={"labels": given}))[0]
    store.assets.delete(anna, given["masks"])
    assert store.assets.find(admin, given["masks"]) is not None, job
