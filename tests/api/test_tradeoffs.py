"""Trade-offs over HTTP: ordered as jobs, looked at, deleted, judged by masks; and one that is real."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.models import AssetKind
from tests.crash.conftest import until
from tests.crash.service_process import processes_of
from tests.server import wait_for_end
from tests.tiny_scene import TinyScene, labels, masks, text_table

from .conftest import SceneAssets, put
from .test_jobs import quick
from .test_problems import NO_ASSET, assert_problem

__all__ = ["quick"]  # a fixture

CLASSES = ["the Lamp", "book", "apple"]  # in another order than the table has them
MASKS = {view: 2 - label_map[0] for view, label_map in labels().items()}  # numbers of these classes


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
