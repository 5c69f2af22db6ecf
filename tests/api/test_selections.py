"""Selections over HTTP: begun, corrected, gone back in, asked like any question; whose they are, and how many."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.store import selections as module
from tests.tiny_scene import SPLATS_A_CLUSTER, WORDS

from .conftest import parts_of
from .test_problems import assert_problem
from .test_queries import array

LAMP = {"query": {"text": [WORDS[2]], "threshold": 0.5}}
ALL = 3 * SPLATS_A_CLUSTER


@pytest.fixture
def route(client: TestClient, lift: dict[str, Any]) -> Iterator[str]:
    yield f"/lifts/{lift['id']}/selections"
    for entry in client.get(f"/lifts/{lift['id']}/selections").json()["selections"]:
        client.delete(entry["links"]["self"])


def begin_selection(client: TestClient, route: str, **edit: Any) -> dict[str, Any]:
    body = {"name": "mine"} | ({"edit": {"operation": "set", **edit}} if edit else {})
    reply = client.post(route, json=body)
    assert reply.status_code == 201, reply.text
    assert reply.headers["location"] == reply.json()["links"]["self"]
    return reply.json()


@pytest.mark.parametrize(("match", "status"), [({}, 409), ({"If-Match": "*"}, 409), ({"If-Match": '"1"'}, 412)])
def test_edit_that_another_one_overtakes_is_refused(
    client: TestClient, route: str, monkeypatch: pytest.MonkeyPatch, match: dict[str, str], status: int
) -> None:
    selection, queries = begin_selection(client, route, **LAMP), parts_of(client).query_client
    edits, call = selection["links"]["edits"], queries.call

    def overtaken(*arguments: Any) -> Any:
        monkeypatch.undo()
        assert client.post(edits, json={"operation": "set"}).status_code == 200
        return call(*arguments)

    monkeypatch.setattr(queries, "call", overtaken)
    late = assert_problem(client.post(edits, json={"operation": "grow"}, headers=match))
    assert (late["status"], late["argument"]) == (status, "selection")
    assert client.get(selection["links"]["self"]).json()["count"] == 0
    assert client.post(edits, json={"operation": "grow"}).status_code == 200


def test_selections_and_their_history_are_bounded(
    client: TestClient, route: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "HISTORY", 2)
    selection = begin_selection(client, route)
    last = selection
    for _ in range(4):
        last = client.post(
            selection["links"]["edits"], json={"operation": "set", "query": {"sets": ["object:0"]}}
        ).json()
    assert (last["step"], last["first"], last["last"]) == (4, 2, 4)
    assert client.patch(selection["links"]["self"], json={"step": 1}).status_code == 422
    monkeypatch.setattr(module, "MAX_SELECTIONS", 1)
    response = client.post(route, json={"name": "more"})
    assert (response.status_code, response.json()["type"]) == (422, "/problems/over-limit")


def test_splat_tells_its_thing(client: TestClient, lift: dict[str, Any]) -> None:
    objects = f"/lifts/{lift['id']}/objects"
    for row in (0, ALL - 1):
        (entry,) = client.get(objects, params={"splat": row}).json()["objects"]
        members = array(client.get("/query/selection", params={"sets": f"object:{entry['id']}"}).content)
        assert members[row] and members.sum() == entry["splats"]
    assert client.get(objects, params={"splat": ALL}).json()["objects"] == []


@pytest.mark.parametrize("corner", ["NaN", "Infinity", "1e400"])
def test_box_without_end_is_a_problem(client: TestClient, route: str, corner: str) -> None:
    selection = begin_selection(client, route)
    body = f'{{"operation": "add", "box": {{"low": [0, 0, 0], "high": [1, 1, {corner}]}}}}'
    reply = client.post(selection["links"]["edits"], content=body, headers={"Content-Type": "application/json"})
    assert (reply.status_code, reply.json()["argument"][:3]) == (422, "box")


def test_area_of_a_vast_camera_is_a_problem(client: TestClient, lift: dict[str, Any], route: str) -> None:
    (view,) = client.get(f"/lifts/{lift['id']}/views", params={"limit": 1}).json()["views"]
    vast = {"area": "vast:stroke:0,0,9,9", "camera": view | {"width": 32768, "height": 32768}}
    reply = client.post(begin_selection(client, route)["links"]["edits"], json={"operation": "add", **vast})
    assert (reply.status_code, reply.json()["argument"]) == (422, "camera")


def test_history_has_no_vectors(client: TestClient, lift: dict[str, Any], route: str) -> None:
    query = {"like": [[1.0] * lift["channels"], "splat:0"], "threshold": 0.5}
    (step,) = begin_selection(client, route, query=query)["history"]
    assert step["edit"]["query"]["like"] == [f"a vector of {lift['channels']} channels", "splat:0"]
