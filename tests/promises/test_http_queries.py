"""Questions over HTTP: words, examples, points and vectors, by GET and POST; their pictures, arrays and splats."""

from __future__ import annotations

import json
from importlib.util import find_spec
from typing import Any

import httpx
import numpy as np
import pytest

from tests.server import Server, until
from tests.tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH, WORDS, codebook, ply, splat_rows, text_table

from .over_http import NO_ASSET, NO_ID, array, assert_problem, delete_lift, lift_of, picture, upload

COLUMNS: dict[str, int] = dict(zip(WORDS, (6, 16, 26), strict=True))  # of view "middle" that show a word
PLACES: dict[str, int] = {word: place for place, word in enumerate(WORDS)}
LAMP = {"text": "lamp", "threshold": 0.5}


def ask(client: httpx.Client, lift: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """Ask a lift by GET; return the answer."""
    reply = client.get("/query", params={"lift": lift["id"], **fields})
    assert reply.status_code == 200, reply.text
    return reply.json()


def is_of(answer: dict[str, Any], word: str) -> bool:
    """Return True if an answer is the cluster of a word, to a splat or two."""
    rows = {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]}
    return rows == {PLACES[word]} and abs(answer["count"] - SPLATS_A_CLUSTER) <= 2


def test_word_selects_its_cluster_in_numbers_arrays_and_pictures(client: httpx.Client, lift: dict[str, Any]) -> None:
    word = "lamp"
    answer = ask(client, lift, text=word, view="middle", threshold=0.5)
    assert is_of(answer, word) and (answer["lift"], answer["text"], answer["view"]) == (lift["id"], [word], "middle")
    assert (answer["threshold"]["value"], answer["threshold"]["method"]) == (0.5, "fixed")
    best = [splat["score"] for splat in answer["top"]]
    assert best == sorted(best, reverse=True)
    links = answer["links"]
    selection = array(client.get(as_selection(links["scores"])).content)
    objects = client.get(links["objects"]).json()
    (entry,) = objects["objects"]
    assert entry["splats"] + objects["unassigned_splats"] == objects["count"] == answer["count"]
    assert entry["centre"][0] == pytest.approx((PLACES[word] - 1) * 1.2, abs=0.2)
    assert client.get(links["object"]).content == ply(splat_rows()[selection])  # the rows to the byte
    for name, link in links.items():
        assert client.get(link).status_code == 200, name


def test_labels_are_exported_in_each_format(client: httpx.Client, lift: dict[str, Any]) -> None:
    questions = [{"text": [word], "threshold": 0.5, "lift": lift["id"]} for word in WORDS]
    body = {"lift": lift["id"], "of": "questions", "questions": questions, "view": "middle"}
    files = {}
    for name, start in {"ply": b"ply", "glb": b"glTF", "usdz": b"PK", "names": b"{", "masks": b"{"}.items():
        reply = client.post("/query/export", json=body | {"format": name})
        if name == "usdz" and find_spec("pxr") is None:  # usd-core is an extra
            assert "usd-core" in assert_problem(reply, 422)["detail"]
            continue
        assert reply.status_code == 200 and reply.content.startswith(start), name
        files[name] = reply.content
    assert {entry["name"] for entry in json.loads(files["names"])["classes"]} == set(WORDS)
    masks = json.loads(files["masks"])
    assert {entry["name"] for entry in masks["categories"]} == set(WORDS)
    assert [image["file_name"] for image in masks["images"]] == ["middle"]
    assert_problem(client.post("/query/export", json=body | {"format": "zip"}), 422)


def as_selection(link: str) -> str:
    return link.replace("/query/scores", "/query/selection")


def test_vector_is_posted_and_so_is_all_that_belongs_to_it(client: httpx.Client, lift: dict[str, Any]) -> None:
    body = {"like": [codebook()[2].tolist()], "unlike": ["middle:6,12"], "view": "middle", "lift": lift["id"]}
    answer = client.post("/query", json=body).json()
    assert is_of(answer, "lamp") and answer["like"] == [f"a vector of {CHANNELS} channels"]
    assert array(client.post(as_selection(answer["links"]["scores"]), json=body).content).sum() == answer["count"]
    for name in ("mask", "attention"):
        content = client.post(answer["links"][name].partition("?")[0], json=body).content
        assert picture(content).shape[:2] == (HEIGHT, WIDTH)
    for wrong in ([1.0] * (CHANNELS - 1), [0.0] * CHANNELS, [], ["x"]):
        assert_problem(client.post("/query", json=body | {"like": [wrong]}), 422)


def test_nothing_selected_is_said_and_has_no_splats(client: httpx.Client, lift: dict[str, Any]) -> None:
    fields = {"lift": lift["id"], "text": "lamp", "negatives": "book", "threshold": 1}
    answer = client.get("/query", params=fields).json()
    assert (answer["count"], answer["clear"], answer["box"]) == (0, False, None)
    assert "object" not in answer["links"]
    problem = assert_problem(client.get("/query/object", params=fields), 422)
    assert "threshold" in problem["hint"]


WRONG: dict[str, tuple[str, dict[str, Any], int, str]] = {
    "no question": ("/query", {}, 422, "query"),
    "an unknown word": ("/query", {"text": ["apple", "zeppelin"], "negatives": ["lamp"]}, 422, "text.1"),
    "a splat that is none": ("/query", {"like": ["splat:1", "splat:60"]}, 422, "like.1"),
    "an unknown view": ("/query", {"unlike": ["behind:1,1"], "like": ["splat:1"]}, 404, "unlike.0"),
    "a pixel outside": ("/query", {"like": ["middle:99,0"]}, 422, "like.0"),
    "an unknown lift": ("/query", {"text": ["apple"], "lift": NO_ID}, 404, "lift"),
    "no lift's id": ("/query", {"text": ["apple"], "lift": "../../etc/passwd"}, 422, "lift"),
    "an unknown parameter": ("/query", {"text": ["lamp"], "treshold": 0.5}, 422, "treshold"),
    "a negative number": ("/query", {"text": ["apple"], "top": -1}, 422, "top"),
    "an unknown encoder": ("/query", {"text": ["apple"], "encoder": "table:/etc/passwd"}, 422, "encoder"),
    "an encoder that does not fit": ("/query", {"text": ["apple"], "encoder": "narrow"}, 422, "encoder"),
    "an unknown table": ("/query", {"text": ["apple"], "table": NO_ASSET}, 404, ""),
    "an unknown object": ("/query", {"sets": ["object:77"]}, 404, ""),
    "a render of an unknown view": ("/render", {"view": "behind"}, 404, "view"),
    "a render of no channel": ("/render", {"view": "left", "channel": "x-rays"}, 422, "channel"),
    "a mask of no view": ("/query/mask", {"text": ["apple"]}, 422, "view"),
    "too many examples": ("/query/scores", {"like": ["splat:1"] * 99}, 422, "like"),
}


@pytest.mark.parametrize("name", WRONG)
def test_question_that_leads_nowhere_names_what_is_wrong(
    client: httpx.Client, lift: dict[str, Any], name: str
) -> None:
    path, fields, status, argument = WRONG[name]
    fields = {"lift": lift["id"]} | fields
    for reply in (client.get(path, params=fields), client.post(path, json=fields)):
        problem = assert_problem(reply, status)
        assert (problem.get("argument") or "").startswith(argument), problem
        assert "/tmp" not in json.dumps(problem) and ".safetensors" not in problem["detail"]


# Words: of the scene, of an uploaded table, of every splat


@pytest.fixture(scope="module")
def table(client: httpx.Client) -> str:
    """A table of other names for the three things, and of one that is not there."""
    names = ("fruit", "novel", "light", "boat")
    return upload(client, "table", text_table(words=names, rows=np.eye(4, CHANNELS, dtype=np.float32)))


def test_uploaded_table_answers_and_completes(client: httpx.Client, lift: dict[str, Any], table: str) -> None:
    assert is_of(ask(client, lift, text="light", table=table), "lamp")
    answer = ask(client, lift, text="some old lights", table=table)
    assert [(entry["text"], entry["word"]) for entry in answer["wording"]] == [("some old lights", "light")]
    fields = {"lift": lift["id"], "table": table}
    problem = assert_problem(client.get("/query", params=fields | {"text": "boaat"}), 422)
    assert (problem["argument"], problem["nearest"]) == ("text.0", ["boat"])
    path = "/query/suggested_words"
    words = client.get(path, params=fields | {"text": "no"}).json()
    assert [entry["word"] for entry in words["words"]] == ["novel"]
    assert set(client.get(path, params=fields).json()["scene_words"]) == {"fruit", "novel", "light"}
    assert_problem(client.get("/query", params=fields | {"text": "light", "encoder": "default"}), 422)
    assert_problem(client.get("/query", params=fields | {"text": "light", "table": lift["splats"]}), 422)
    for words in ([], ["novel", "novel"], ["zeppelin"]):
        assert_problem(client.post("/query/segment", json=fields | {"words": words}), 422)


def test_newest_lift_answers_where_none_is_named_in_the_words_of_its_order(
    client: httpx.Client, order: dict[str, Any], table: str
) -> None:
    newest = lift_of(client, order | {"table": table})
    answer = client.get("/query", params={"text": "light"}).json()
    assert answer["lift"] == newest["id"] and is_of(answer, "lamp")
    assert array(client.get(answer["links"]["scores"]).content).shape == (60,)
    views = [view["name"] for view in client.get(f"/lifts/{newest['id']}/views").json()["views"]]
    masks = {view: client.get("/query/mask", params={"text": "light", "view": view}).content for view in views}
    areas = {view: (picture(mask) > 0).sum() for view, mask in masks.items()}
    mask = picture(client.get(answer["links"]["mask"]).content)  # of the view that shows most of it
    assert (mask > 0).sum() == areas[answer["view"]] == max(areas.values()) > 0
    assert_problem(client.delete(f"/assets/{table}"), 409)
    delete_lift(client, newest["id"])


def test_answer_from_the_cache_is_the_answer(client: httpx.Client, lift: dict[str, Any]) -> None:
    paths = {
        "/query": LAMP, "/query/scores": LAMP, "/query/objects": LAMP,
        "/query/mask": LAMP | {"view": "left"}, "/render": {"view": "left"},
    }  # fmt: skip
    for path, fields in paths.items():
        first, second = (client.get(path, params=fields | {"lift": lift["id"]}) for _ in range(2))
        assert first.status_code == 200 and first.content == second.content
        tag = first.headers.get("etag")
        if tag is not None:
            other = client.get(path, params=fields | {"lift": lift["id"]}, headers={"If-None-Match": tag})
            assert (other.status_code, other.content) == (304, b"")


def test_no_file_of_an_answer_stays_behind_it(client: httpx.Client, server: Server, lift: dict[str, Any]) -> None:
    for part, status in (("0-3", 206), ("999999-", 416), ("nonsense", 400)):
        parameters = LAMP | {"lift": lift["id"]}
        reply = client.get("/query/scores", params=parameters, headers={"Range": f"bytes={part}"})
        assert reply.status_code == status, reply.text
    assert until(lambda: not any((server.data / "tmp").iterdir()))
