"""Selections over HTTP: begun, corrected, gone back in, and asked like any question."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from tests.tiny_scene import SPLATS_A_CLUSTER, WORDS

from .over_http import array, assert_problem

LAMP = {"query": {"text": [WORDS[2]], "threshold": 0.5}}
COUNT = 3 * SPLATS_A_CLUSTER


@pytest.fixture
def route(client: httpx.Client, lift: dict[str, Any]) -> Iterator[str]:
    path = f"/lifts/{lift['id']}/selections"
    yield path
    for entry in client.get(path).json()["selections"]:
        assert client.delete(entry["links"]["self"]).status_code == 204


def begin(client: httpx.Client, route: str, **edit: Any) -> dict[str, Any]:
    """Begin a selection with an edit."""
    body = {"name": "mine"} | ({"edit": {"operation": "set", **edit}} if edit else {})
    reply = client.post(route, json=body)
    assert reply.status_code == 201, reply.text
    assert reply.headers["location"] == reply.json()["links"]["self"]
    return reply.json()


def edit_of(client: httpx.Client, selection: dict[str, Any], **edit: Any) -> dict[str, Any]:
    """Edit a selection; return what it became."""
    reply = client.post(selection["links"]["edits"], json=edit)
    assert reply.status_code == 200, reply.text
    return reply.json()


def rows_of(client: httpx.Client, selection: dict[str, Any]) -> list[int]:
    """Return the rows of a selection."""
    return np.flatnonzero(array(client.get(selection["links"]["selection"]).content)).tolist()


def test_selection_is_begun_corrected_and_undone(client: httpx.Client, route: str) -> None:
    selection = begin(client, route, **LAMP)
    lamp = rows_of(client, selection)
    assert selection["count"] == len(lamp) and set(lamp) <= set(range(40, 60)) and selection["box"]
    addition = edit_of(client, selection, operation="add", area="middle:box:10,24,0,0", through=True)
    assert rows_of(client, addition) == [*range(SPLATS_A_CLUSTER), *lamp] and addition["count"] == 20 + len(lamp)
    back = client.patch(selection["links"]["self"], json={"step": 0}).json()
    assert (back["step"], rows_of(client, back)) == (0, lamp)
    forward = client.patch(selection["links"]["self"], json={"step": 1}).json()
    assert forward["count"] == addition["count"]
    client.patch(selection["links"]["self"], json={"step": 0})
    removal = edit_of(client, selection, operation="remove", query={"like": ["splat:59"], "threshold": 0.5})
    assert (removal["step"], removal["count"]) == (1, 0)  # what was undone is forgotten
    other_name = client.patch(selection["links"]["self"], json={"name": "the lamp"}).json()
    assert client.get(route).json()["selections"][0]["name"] == other_name["name"] == "the lamp"


def test_selection_of_bits_is_asked_exported_and_an_example(
    client: httpx.Client, lift: dict[str, Any], route: str
) -> None:
    bits = np.packbits(np.arange(COUNT) >= COUNT - 3, bitorder="little")
    selection = begin(client, route, bits=base64.b64encode(bits.tobytes()).decode())
    assert rows_of(client, selection) == [57, 58, 59]
    answer = client.get(selection["links"]["query"]).json()
    assert answer["count"] == 3
    for name, link in answer["links"].items():
        assert client.get(link).status_code == 200, name
    assert b"element vertex 3\n" in client.get(selection["links"]["object"]).content[:200]
    like = {"lift": lift["id"], "like": f"selection:{selection['id']}"}
    assert client.get("/query", params=like).json()["count"] > 10
    edit_of(client, selection, operation="set", query={"sets": ["object:0"]})
    assert client.get(selection["links"]["query"]).json()["count"] == 20  # and not the answer from before


def test_edit_of_an_older_version_is_refused(client: httpx.Client, route: str) -> None:
    selection = begin(client, route, **LAMP)
    edits, path = selection["links"]["edits"], selection["links"]["self"]
    tag = client.get(path).headers["etag"]
    first = client.post(edits, json={"operation": "set"}, headers={"If-Match": tag})
    assert first.status_code == 200
    for method, address, body in (
        ("POST", edits, {"operation": "grow"}),
        ("PATCH", path, {"step": 0}),
        ("DELETE", path, None),
    ):
        late = client.request(method, address, json=body, headers={"If-Match": tag})
        assert assert_problem(late, 412)["type"] == "/problems/changed"
    assert client.get(path).json()["count"] == 0
    current = client.get(path).headers["etag"]
    assert client.patch(path, json={"step": 0}, headers={"If-Match": current}).status_code == 200


@pytest.mark.parametrize(
    ("edit", "status", "argument"),
    [
        ({"operation": "add"}, 422, "operation"),
        ({"operation": "add", "bits": "AA=="}, 422, "bits"),
        ({"operation": "add", "area": "nowhere:box:0,0,3,3"}, 404, "view"),
        ({"operation": "add", "query": {"sets": ["object:77"]}}, 404, ""),
    ],
    ids=str,
)
def test_wrong_edit_is_a_problem_and_changes_nothing(
    client: httpx.Client, route: str, edit: dict[str, Any], status: int, argument: str
) -> None:
    selection = begin(client, route, **LAMP)
    problem = assert_problem(client.post(selection["links"]["edits"], json=edit), status)
    assert argument in problem["argument"]
    after = client.get(selection["links"]["self"]).json()
    assert (after["count"], after["step"]) == (selection["count"], selection["step"])


def test_deleted_selection_is_gone(client: httpx.Client, lift: dict[str, Any], route: str) -> None:
    selection = begin(client, route)
    assert selection["count"] == 0
    assert client.delete(selection["links"]["self"]).status_code == 204
    for path in (selection["links"]["self"], f"{route}/{'0' * 16}"):
        assert_problem(client.get(path), 404)
        assert_problem(client.delete(path), 404)
    sets = {"lift": lift["id"], "sets": f"selection:{selection['id']}"}
    assert_problem(client.get("/query", params=sets), 404)
    for wrong in ({}, {"name": ""}, {"name": "x", "extra": 1}):
        assert_problem(client.post(route, json=wrong), 422)
