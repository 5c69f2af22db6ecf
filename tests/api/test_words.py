"""Many words at once, and the words of an uploaded table, over HTTP."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from .test_problems import assert_problem
from .tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH, WORDS, text_table

PLACES: dict[str, int] = dict(zip(WORDS, (6, 16, 26), strict=True))  # columns of view "middle" that show them


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


@pytest.mark.parametrize(
    ("path", "body", "argument"),
    [
        ("/query/segment", {"words": []}, "words"),
        ("/query/segment", {"words": ["lamp", "lamp"]}, "words"),
        ("/query/segment", {"words": ["zeppelin"]}, "text"),
        ("/query/segment/map", {}, "view"),
        ("/query/what", {"example": "middle:99,0"}, "middle:99,0"),
    ],
)
def test_words_that_name_nothing_are_problems(
    client: TestClient, lift: dict[str, Any], path: str, body: dict[str, Any], argument: str
) -> None:
    told = assert_problem(client.post(path, json={"lift": lift["id"]} | body))
    assert (told["status"], told.get("argument")) == (422, argument), told
