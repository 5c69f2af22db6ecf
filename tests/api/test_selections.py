"""Selections over HTTP: begun, corrected, gone back in, asked like any question; whose they are, and how many."""

from __future__ import annotations

import base64
import csv
import io
import json
import sqlite3
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from plyfile import PlyData
from safetensors.numpy import load

from liftcore.errors import NotFound
from service.store import selections as module
from service.store.database import DATABASE, OF_0_4, TABLES_OF_0_4
from service.store.owners import SERVICE, stored_bytes
from service.store.store import Store
from tests.tiny_scene import SPLATS_A_CLUSTER, WORDS

from .conftest import parts_of
from .guarded import KeyedServer, keyed_server
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


def splats_of(client: TestClient, selection: dict[str, Any]) -> list[int]:
    """Its rows, by the question and by its bits."""
    array_of_bits = array(client.get(selection["links"]["selection"]).content)
    bits = client.get(selection["links"]["self"], params={"bits": True}).json()["bits"]
    bits_of_splats = np.unpackbits(np.frombuffer(base64.b64decode(bits), np.uint8), count=ALL, bitorder="little")
    assert (array_of_bits == bits_of_splats).all()
    return np.flatnonzero(array_of_bits).tolist()


def test_selection_is_begun_edited_and_gone_back_in(client: TestClient, route: str) -> None:
    selection = begin_selection(client, route, **LAMP)
    lamp = splats_of(client, selection)
    assert 0 < selection["count"] == len(lamp) < ALL
    assert (selection["step"], selection["first"], selection["last"]) == (0, 0, 0)
    edits = selection["links"]["edits"]
    with_apple = client.post(edits, json={"operation": "add", "area": "middle:box:0,0,10,24", "through": True}).json()
    assert with_apple["count"] == len(lamp) + SPLATS_A_CLUSTER and with_apple["box"] is not None
    assert [step["count"] for step in with_apple["history"]] == [len(lamp), with_apple["count"]]
    assert with_apple["history"][1]["edit"]["area"] == "middle:box:0,0,10,24"
    back = client.patch(selection["links"]["self"], json={"step": 0}).json()
    assert (back["step"], back["last"], splats_of(client, back)) == (0, 1, lamp)
    after_growth = client.post(edits, json={"operation": "grow", "steps": 9}).json()  # what was undone is forgotten
    assert (after_growth["step"], after_growth["last"]) == (1, 1)
    assert splats_of(client, after_growth) == list(range(2 * SPLATS_A_CLUSTER, ALL))
    after_rename = client.patch(selection["links"]["self"], json={"name": "the lamp"}).json()
    assert client.get(route).json()["selections"][0]["name"] == after_rename["name"] == "the lamp"
    assert client.delete(selection["links"]["self"]).status_code == 204
    assert client.get(selection["links"]["self"]).status_code == 404


def test_selection_is_asked_exported_and_an_example(client: TestClient, lift: dict[str, Any], route: str) -> None:
    bits = np.packbits(np.arange(ALL) >= ALL - 3, bitorder="little")
    selection = begin_selection(client, route, bits=base64.b64encode(bits.tobytes()).decode())
    assert splats_of(client, selection) == [ALL - 3, ALL - 2, ALL - 1]
    answer = client.get(selection["links"]["query"]).json()
    assert (answer["count"], answer["present"]) == (3, True)
    for name, link in answer["links"].items():
        assert client.get(link).status_code == 200, name
    assert b"element vertex 3\n" in client.get(selection["links"]["splats"]).content[:200]
    like = {"lift": lift["id"], "like": f"selection:{selection['id']}"}
    assert client.get("/query", params=like).json()["count"] > 10
    tag = client.get(selection["links"]["selection"]).headers["etag"]
    client.post(selection["links"]["edits"], json={"operation": "set", "query": {"sets": ["object:0"]}})
    response = client.get(selection["links"]["selection"], headers={"If-None-Match": tag})
    assert response.status_code == 200 and array(response.content).sum() > 3


def test_edit_of_an_older_version_is_refused(client: TestClient, route: str) -> None:
    selection = begin_selection(client, route, **LAMP)
    edits, selection_path = selection["links"]["edits"], selection["links"]["self"]
    tag = client.get(selection_path).headers["etag"]
    first = client.post(edits, json={"operation": "grow"}, headers={"If-Match": tag})
    assert first.status_code == 200 and first.headers["etag"] != tag
    for method, path, body in (
        ("POST", edits, {"operation": "grow"}),
        ("PATCH", selection_path, {"step": 0}),
        ("DELETE", selection_path, None),
    ):
        late = client.request(method, path, json=body, headers={"If-Match": tag})
        assert (late.status_code, late.json()["type"]) == (412, "/problems/changed")
    for tag in ("", "another", '"another"'):
        assert client.post(edits, json={"operation": "grow"}, headers={"If-Match": tag}).status_code == 412
    assert (
        client.patch(selection_path, json={"step": 0}, headers={"If-Match": f"W/{first.headers['etag']}"}).status_code
        == 200
    )
    assert client.delete(selection_path, headers={"If-Match": "*"}).status_code == 204


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


@pytest.mark.parametrize(
    ("body", "argument"),
    [
        ({"operation": "add"}, "operation"),
        ({"operation": "grow", "bits": "AA=="}, "operation"),
        ({"operation": "add", "bits": "AA=="}, "bits"),
        ({"operation": "add", "bits": "!"}, "bits"),
        ({"operation": "add", "area": "middle:3,3"}, "area"),
        ({"operation": "add", "box": 3}, "box"),
        ({"operation": "add", "box": []}, "box"),
        ({"operation": "add", "box": "ab"}, "box"),
        ({"operation": "add", "box": [1, 2]}, "box.low"),
        ({"operation": "add", "area": "nowhere:box:0,0,3,3"}, "view"),
        ({"operation": "add", "query": {"sets": ["selection:0123456789abcdef"]}}, "selection"),
        ({"operation": "add", "query": {"sets": ["object:77"]}}, "object"),
        ({"operation": "add", "query": {"text": ["lamp"], "sets": ["object:0"]}}, "sets"),
        ({"operation": "add", "query": {"text": ["lamp"], "lift": "0" * 32}}, "edit.query.lift"),
        ({"operation": "shrink", "steps": 0}, "steps"),
    ],
)
def test_wrong_edits_are_problems_and_change_nothing(
    client: TestClient, route: str, body: dict[str, Any], argument: str
) -> None:
    selection = begin_selection(client, route)
    reply = client.post(selection["links"]["edits"], json=body)
    assert reply.status_code in (404, 422) and argument in reply.json()["argument"], reply.text
    assert client.get(selection["links"]["self"]).json()["version"] == 1


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


def test_selections_of_a_lift_take_no_more_bytes_than_its_splats_allow(
    client: TestClient, lift: dict[str, Any], route: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 0)
    monkeypatch.setattr(module, "BYTES_A_SPLAT", 2)
    edits = begin_selection(client, route)["links"]["edits"]
    while (reply := client.post(edits, json={"operation": "set"})).status_code == 200:
        assert reply.json()["step"] < 2 * lift["count"]
    assert assert_problem(reply)["type"] == "/problems/over-limit"
    assert client.delete(client.get(route).json()["selections"][0]["links"]["self"]).status_code == 204
    assert client.post(route, json={"name": "more"}).status_code == 201


def test_things_take_names_and_are_hidden(client: TestClient, lift: dict[str, Any], route: str) -> None:
    objects = f"/lifts/{lift['id']}/objects"
    objects_before = client.get(objects).json()["objects"]
    assert objects_before and not any(entry["hidden"] for entry in objects_before)
    assert client.patch(f"{objects}/0", json={"name": "the mug"}).json() == {
        "id": 0, "name": "the mug", "hidden": False
    }  # fmt: skip
    assert client.patch(f"{objects}/0", json={"hidden": True}).json()["name"] == "the mug"
    first = client.get(objects).json()["objects"][0]
    assert (first["name"], first["score"], first["hidden"]) == ("the mug", None, True)
    assert client.patch(f"{objects}/0", json={"name": None, "hidden": False}).status_code == 200
    assert client.get(objects).json()["objects"] == objects_before
    assert client.patch(f"{objects}/99", json={"hidden": True}).status_code == 404


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


def test_export_takes_the_step_that_is_shown(client: TestClient, lift: dict[str, Any], route: str) -> None:
    selection = begin_selection(client, route, query={"sets": ["object:0"]})
    client.get(selection["links"]["query"])  # whose answer is kept
    other = client.post(selection["links"]["edits"], json={"operation": "set"}).json()
    assert client.get(other["links"]["query"]).json()["count"] == 0
    assert client.patch(selection["links"]["self"], json={"step": 0}).status_code == 200
    export_class = {"name": "mine", "sets": [f"selection:{selection['id']}"]}
    assert exported_counts(client, export_class) == {"mine": selection["count"]}


def test_questions_of_one_name_are_both_exported(client: TestClient, lift: dict[str, Any]) -> None:
    objects = [{"name": "mine", "sets": [f"object:{number}"]} for number in (0, 1)]
    assert set(exported_counts(client, *objects)) == {"mine", "mine 2"}


def exported_counts(client: TestClient, *questions: dict[str, Any]) -> dict[str, int]:
    """The splats of each question's answer, by its name in the table of an export."""
    reply = client.post("/query/export", json={"of": "questions", "questions": questions, "view": "left"})
    with zipfile.ZipFile(io.BytesIO(reply.content)) as archive:
        table = list(csv.DictReader(io.StringIO(archive.read("instances.csv").decode())))
    return {row["name"]: int(row["splats"]) for row in table}


def test_lift_that_is_deleted_meanwhile_takes_no_selection_and_no_name(client: TestClient) -> None:
    selections = parts_of(client).store.selections
    empty_set = module.SplatSet({"operation": "set"}, 0, None, b"\0")
    with pytest.raises(NotFound):
        selections.create(SERVICE, "0" * 32, "mine", empty_set)
    with pytest.raises(NotFound):
        selections.change_object_label("0" * 32, 0, {"name": "the mug"})


@pytest.fixture
def alice_server(tmp_path: Path) -> Iterator[KeyedServer]:
    with keyed_server(tmp_path / "data") as server:
        yield server


def test_selection_belongs_to_whom_its_lift_does_and_goes_with_it(alice_server: KeyedServer) -> None:
    route = f"/lifts/{alice_server.lift_job}/selections"
    selection_path = alice_server.ask("alice", "POST", route, json={"name": "hers"}).json()["links"]["self"]
    assert alice_server.ask("boss", "GET", selection_path).status_code == 200
    for method, path in (
        ("GET", route),
        ("GET", selection_path),
        ("DELETE", selection_path),
        ("PATCH", selection_path),
        ("POST", f"{selection_path}/edits"),
    ):
        body = {"operation": "grow"} if method == "POST" else {} if method == "PATCH" else None
        assert alice_server.ask("bob", method, path, json=body).status_code == 404
    assert alice_server.ask("bob", "DELETE", f"/lifts/{alice_server.lift_job}").status_code == 404
    assert alice_server.ask("alice", "DELETE", f"/lifts/{alice_server.lift_job}").status_code == 204
    assert alice_server.ask("alice", "GET", f"/jobs/{alice_server.lift_job}").status_code == 404
    with alice_server.store.database.read() as connection:
        assert connection.execute("SELECT count(*) FROM selection_steps").fetchone()[0] == 0


def test_selections_count_for_the_quota(client: TestClient, lift: dict[str, Any], route: str) -> None:
    with parts_of(client).store.database.read() as connection:
        before = stored_bytes(connection, SERVICE)
        begin_selection(client, route, **LAMP)
        assert stored_bytes(connection, SERVICE) > before


def test_database_of_release_0_4_gets_the_tables_of_selections(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    old = sqlite3.connect(tmp_path / "data" / DATABASE)
    old.executescript(TABLES_OF_0_4)
    old.execute(f"PRAGMA user_version = {OF_0_4}")
    old.close()
    for _ in range(2):
        store = Store.open(tmp_path / "data")
        with store.database.read() as connection:
            assert connection.execute("SELECT count(*) FROM selections").fetchone()[0] == 0
        store.close()


def test_everything_comes_in_one_zip(client: TestClient, lift: dict[str, Any], route: str) -> None:
    selection = begin_selection(client, route, query={"sets": ["object:0"]})
    classes_body = [
        {"text": [WORDS[2]], "threshold": 0.5},
        {"name": "mine", "sets": [f"selection:{selection['id']}"]},
    ]
    reply = client.post("/query/export", json={"of": "questions", "questions": classes_body})
    assert reply.status_code == 200 and 'filename="lamp-mine-' in reply.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(reply.content)) as archive:
        assert archive.testzip() is None
        document = json.loads(archive.read("labels.json"))
        assert [entry["name"] for entry in document["classes"]] == ["lamp", "mine"]
        rows = PlyData.read(io.BytesIO(archive.read("labels.ply")))["vertex"].data
        coco = json.loads(archive.read("masks.json"))
        assert len(coco["images"]) == 3
        table = list(csv.DictReader(io.StringIO(archive.read("instances.csv").decode())))
        assert {row["name"]: int(row["splats"]) for row in table}["mine"] == (rows["class_id"] == 2).sum() > 0
        with Image.open(io.BytesIO(archive.read("masks/middle.png"))) as picture:
            mask, legend = np.asarray(picture), json.loads(picture.info["legend"])
        (annotation,) = [
            entry for entry in coco["annotations"] if entry["image_id"] == 2 and entry["category_id"] == 1
        ]
        assert (
            annotation["area"] == (mask == annotation["instance_id"]).sum() > 0
            and legend[str(annotation["instance_id"])][:4] == "lamp"
        )
        truth = load(archive.read("truth.safetensors"))["middle/mask"]
        assert ((truth == 0) == (mask == annotation["instance_id"])).all() and truth.min() == -1
    assert client.patch(f"/lifts/{lift['id']}/objects/0", json={"name": "the mug"}).status_code == 200
    response = client.post("/query/export", json={"view": "left"})
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        assert b"the mug" in archive.read("instances.csv")
        assert [name for name in archive.namelist() if name.startswith("masks/")] == ["masks/left.png"]
    client.patch(f"/lifts/{lift['id']}/objects/0", json={"name": None})
    assert client.post("/query/export", json={"of": "questions"}).status_code == 422
