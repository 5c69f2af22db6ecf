"""Many words at once, the words of an uploaded table, and cameras that no file has, over HTTP."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from .test_problems import assert_problem
from .tiny_scene import CHANNELS, FOCAL, HEIGHT, SPLATS_A_CLUSTER, VIEWS, WIDTH, WORDS, text_table

PLACES: dict[str, int] = dict(zip(WORDS, (6, 16, 26), strict=True))  # columns of view "middle" that show them
POSE = [[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]  # as "middle" stands, in OpenCV's axes


@pytest.fixture(scope="module")
def own_table(client: TestClient) -> str:
    """A table of other names for the three things, and of one that is not there."""
    names = ("fruit", "novel", "light", "boat")
    content = text_table(words=names, rows=np.eye(4, CHANNELS, dtype=np.float32))
    return client.put("/assets/table", content=content).json()["id"]


def picture_of(client: TestClient, path: str, body: dict[str, Any]) -> Image.Image:
    reply = client.post(path, json=body)
    assert reply.status_code == 200, reply.text
    return Image.open(io.BytesIO(reply.content))


def test_every_splat_gets_its_word_of_the_table(client: TestClient, lift: dict[str, Any], own_table: str) -> None:
    body = {"lift": lift["id"], "table": own_table, "view": "middle"}
    told = client.post("/query/segment", json=body).json()
    found = {word["word"]: word for word in told["found"]}
    assert (set(found), told["words"], told["encoder"]) == ({"fruit", "novel", "light"}, 4, "table")
    assert found["fruit"]["box"]["high"][0] < found["novel"]["box"]["low"][0]
    labels = np.load(io.BytesIO(client.post("/query/segment/labels", json=body).content), allow_pickle=False)
    assert (labels == 0).sum() == told["none"]
    own = labels[2 * SPLATS_A_CLUSTER :]
    assert set(own.tolist()) - {0} == {found["light"]["value"]}
    seen = picture_of(client, "/query/segment/map", body)
    legend = json.loads(seen.text["legend"])  # pyright: ignore[reportAttributeAccessIssue]: of a PNG
    values = np.asarray(seen)[HEIGHT // 2]
    assert [legend[str(values[column])] for column in PLACES.values()] == ["fruit", "novel", "light"]
    assert picture_of(client, "/query/segment/picture", body).width > WIDTH


@pytest.mark.parametrize("word", WORDS)
def test_what_this_is_names_the_nearest_words(client: TestClient, lift: dict[str, Any], word: str) -> None:
    for example in (f"middle:{PLACES[word]},12", f"splat:{SPLATS_A_CLUSTER * WORDS.index(word)}"):
        body = {"lift": lift["id"], "example": example, "top": 2}
        best = client.post("/query/what", json=body).json()["words"]
        assert best[0]["word"] == word and best[0]["score"] > best[1]["score"]


def test_an_uploaded_table_answers_questions(client: TestClient, lift: dict[str, Any], own_table: str) -> None:
    asked = {"lift": lift["id"], "text": "light", "table": own_table, "view": "middle"}
    answer = client.get("/query", params=asked).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {2}
    for link in answer["links"].values():
        assert client.get(link).status_code == 200
    for wrong, status in ((lift["splats"], 422), ("sha256:" + "0" * 64, 404)):
        assert assert_problem(client.get("/query", params=asked | {"table": wrong}))["status"] == status
    assert assert_problem(client.get("/query", params=asked | {"encoder": "default"}))["argument"] == "table"


def test_a_camera_of_no_file_sees_what_a_view_sees(client: TestClient, lift: dict[str, Any]) -> None:
    """The same pose gives the same picture; an entry of the list of views is a camera; another pose sees no less."""
    own = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "viewmat": POSE}
    named = {view["name"]: view for view in client.get(f"/lifts/{lift['id']}/views").json()["views"]}
    for path, question in (
        ("/query/mask", {"text": ["lamp"]}),
        ("/query/attention", {"text": ["lamp"]}),
        ("/render", {}),
    ):
        asked = {"lift": lift["id"], **question}
        by_name = picture_of(client, path, asked | {"view": "middle"}).tobytes()
        assert picture_of(client, path, asked | {"camera": own}).tobytes() == by_name
        assert picture_of(client, path, asked | {"camera": named["middle"]}).tobytes() == by_name
    larger = own | {"width": 2 * WIDTH, "height": 2 * HEIGHT, "fx": 2 * FOCAL}
    mask = np.asarray(picture_of(client, "/query/mask", {"lift": lift["id"], "text": ["lamp"], "camera": larger}))
    assert mask.shape == (2 * HEIGHT, 2 * WIDTH) and np.nonzero(mask)[1].min() > WIDTH
    assert list(named) == list(VIEWS)


@pytest.mark.parametrize(
    ("path", "body", "argument"),
    [
        ("/query/mask", {"text": ["lamp"]}, "view"),
        ("/query/mask", {"text": ["lamp"], "camera": {}}, "camera.width"),
        ("/query/mask", {"text": ["lamp"], "camera": {"fx": 0}}, "camera 'camera' intrinsics"),
        ("/query/mask", {"text": ["lamp"], "camera": {"viewmat": np.zeros((4, 4)).tolist()}}, "camera 'camera' pose"),
        ("/query/mask", {"text": ["lamp"], "camera": {"viewmat": [[1, 0, 0, 0]] * 3}}, "camera.viewmat"),
        ("/render", {"view": "middle", "camera": {"fx": FOCAL}}, "view"),
        ("/render", {"view": "middle", "what": "confidence"}, "what"),
        ("/query/segment", {"words": []}, "words"),
        ("/query/segment", {"words": ["lamp", "lamp"]}, "words"),
        ("/query/segment", {"words": ["zeppelin"]}, "text"),
        ("/query/segment/map", {}, "view"),
        ("/query/what", {"example": "middle:99,0"}, "middle:99,0"),
    ],
)
def test_bodies_that_make_no_picture_are_problems(
    client: TestClient, lift: dict[str, Any], path: str, body: dict[str, Any], argument: str
) -> None:
    if body.get("camera"):
        body = body | {"camera": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "viewmat": POSE} | body["camera"]}
    told = assert_problem(client.post(path, json={"lift": lift["id"]} | body))
    assert (told["status"], told.get("argument")) == (422, argument), told
