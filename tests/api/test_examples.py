"""Query by example over HTTP: pixels, regions, splats and vectors, with words or without an encoder."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from safetensors.numpy import load, save

from .conftest import Uploaded
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH, TinyScene, codebook

LAMP = (26, HEIGHT // 2)  # a pixel of the lamp in view "middle"
ROUTES = ("/query", "/query/objects", "/query/scores", "/query/mask", "/query/attention", "/query/splats")
NEED_NO_VIEW = ("/query/objects", "/query/scores", "/query/splats")


def of_lamp(answer: dict[str, Any]) -> bool:
    rows = {splat["splat"] for splat in answer["top"]}
    return rows <= set(range(2 * SPLATS_A_CLUSTER, 3 * SPLATS_A_CLUSTER)) and answer["count"] > 10


@pytest.mark.parametrize("like", ["middle:26,12", "region:left:0:2", f"splat:{2 * SPLATS_A_CLUSTER}"])
def test_an_example_finds_more_of_it_and_its_links_lead_somewhere(
    client: TestClient, lift: dict[str, Any], like: str
) -> None:
    answer = client.get("/query", params={"like": like, "view": "middle", "lift": lift["id"]}).json()
    assert of_lamp(answer), answer
    assert (answer["like"], answer["text"]) == ([like], [])
    for name, link in answer["links"].items():
        assert client.get(link).status_code == 200, name
    mask = np.asarray(Image.open(io.BytesIO(client.get(answer["links"]["mask"]).content)))
    assert np.nonzero(mask)[1].min() >= WIDTH // 2


def test_a_vector_is_asked_by_post_and_so_are_its_pictures(client: TestClient, lift: dict[str, Any]) -> None:
    body = {"like": [codebook()[2].tolist()], "unlike": ["middle:6,12"], "view": "middle", "lift": lift["id"]}
    reply = client.post("/query", json=body)
    assert reply.status_code == 200, reply.text
    answer = reply.json()
    assert of_lamp(answer) and answer["like"] == [f"a vector of {CHANNELS} channels"]
    assert (answer["links"]["mask"], answer["links"]["scores"]) == ("/query/mask", "/query/scores")
    by_post = client.post(answer["links"]["scores"], json=body)
    by_get = client.get(
        "/query/scores", params={"like": "region:left:0:2", "unlike": "middle:6,12", "lift": lift["id"]}
    )
    ours, theirs = (np.load(io.BytesIO(reply.content), allow_pickle=False) for reply in (by_post, by_get))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    for name in ("mask", "attention"):
        picture = client.post(answer["links"][name], json=body)
        assert Image.open(io.BytesIO(picture.content)).size == (WIDTH, HEIGHT)


def test_words_and_examples_make_one_query(client: TestClient, lift: dict[str, Any]) -> None:
    both = {"text": ["apple"], "like": ["middle:26,12"], "negatives": ["book"], "threshold": 0.5, "lift": lift["id"]}
    by_post, by_get = client.post("/query", json=both).json(), client.get("/query", params=both).json()
    assert by_post == by_get
    assert client.get(by_post["links"]["mask"]).status_code == 200
    assert by_post["count"] > 1.5 * SPLATS_A_CLUSTER


def test_pictures_of_examples_have_their_own_tags(client: TestClient, lift: dict[str, Any]) -> None:
    def tag(**more: Any) -> str:
        params = {"like": "middle:26,12", "view": "middle", "lift": lift["id"]} | more
        reply = client.get("/query/mask", params=params)
        again = client.get("/query/mask", params=params, headers={"If-None-Match": reply.headers["etag"]})
        assert (reply.status_code, again.status_code) == (200, 304)
        return reply.headers["etag"]

    changes: list[dict[str, Any]] = [
        {}, {"like": "middle:25,12"}, {"unlike": "middle:6,12"}, {"keep": "largest"}, {"instances": 2},
        {"text": "lamp"},
    ]  # fmt: skip
    assert len({tag(**change) for change in changes}) == len(changes)


def test_features_without_words_are_asked_by_example_only(start: Callable[..., Any], scene: TinyScene) -> None:
    silent = {"text_space": "none", "encoder": "a CNN", "normalised": "true"}
    with start(text_spaces={}) as client:
        ids = [
            client.put(f"/assets/{kind}", content=content).json()["id"]
            for kind, content in (
                ("splats", scene.splats),
                ("cameras", scene.cameras),
                ("features", save(load(scene.features), silent)),
            )
        ]
        job = client.post("/lift", json=Uploaded(*ids).order())
        assert ended(client, job.headers["location"])["state"] == "succeeded"
        assert of_lamp(client.get("/query", params={"like": "middle:26,12"}).json())
        refused = assert_problem(client.get("/query", params={"like": "middle:26,12", "text": "lamp"}))
        assert refused["status"] == 422


@pytest.mark.parametrize(
    ("change", "status", "argument"),
    [
        ({}, 422, "query"),
        ({"unlike": "splat:1"}, 422, "query"),
        ({"negatives": "apple"}, 422, "query"),
        ({"like": "behind:1,1"}, 404, "like.0"),
        ({"like": "middle:32,0"}, 422, "like.0"),
        ({"like": "middle:0,0"}, 422, "like.0"),
        ({"like": "middle"}, 422, "like.0"),
        ({"unlike": "nowhere", "like": "splat:1"}, 422, "unlike.0"),
        ({"unlike": ["splat:2", "behind:1,1"], "like": "splat:1"}, 404, "unlike.1"),
        ({"like": ["splat:1", "splat:60"], "text": "apple", "negatives": "lamp"}, 422, "like.1"),
        ({"like": "splat:" + "9" * 500}, 422, "like.0"),
        ({"like": "region:left:0:9"}, 404, "like.0"),
        ({"like": "region:left:7:0"}, 404, "like.0"),
        ({"like": "region:behind:0:0"}, 404, "like.0"),
        ({"like": ""}, 422, "like.0"),
        ({"like": "a\ud800:1,1"}, 404, "like.0"),
        ({"text": "apple", "negatives": " "}, 422, "negatives.0"),
        ({"text": ["apple", "zeppelin"], "negatives": "lamp"}, 422, "text.1"),
        ({"text": "apple", "negatives": ["lamp", "zeppelin"], "like": "splat:1"}, 422, "negatives.1"),
        ({"like": ["splat:1"] * 33}, 422, "like"),
        ({"like": "splat:1", "instances": 0}, 422, "instances"),
        ({"like": "splat:1", "keep": "some"}, 422, "keep"),
    ],
)  # fmt: skip
def test_examples_that_lead_nowhere_are_problems(
    client: TestClient, lift: dict[str, Any], change: dict[str, Any], status: int, argument: str
) -> None:
    known = {
        name: value.encode("utf-8", "replace").decode() if isinstance(value, str) else value
        for name, value in change.items()
    }
    body = assert_problem(client.get("/query", params={"lift": lift["id"]} | known))
    assert (body["status"], body["argument"]) == (status, argument), body


def test_what_an_example_lacks_is_told_beside_it(client: TestClient, lift: dict[str, Any]) -> None:
    def told(**asked: Any) -> str:
        return client.get("/query", params={"lift": lift["id"]} | asked).json()["detail"]

    assert told(like="splat:60") == "like.0: expected a splat in 0..59, got 60 in splat:60"
    assert told(unlike="splat:1") == (
        "query: expected a text or an example of what to look for, got only what it is not; say what to look for, too"
    )
    assert told(like="behind:1,1").startswith("like.0: expected the name of a camera, got 'behind' in behind:1,1")


@pytest.mark.parametrize("path", ROUTES)
@pytest.mark.parametrize(
    "body",
    [
        b"{}", b"[]", b"not json", b"", b"[" * 100_000,
        b'{"like": []}', b'{"like": "splat:1"}', b'{"like": [[]]}', b'{"like": [[1, 2]]}', b'{"like": [[NaN]]}',
        b'{"like": [[0,0,0,0,0,0,0,0]]}', b'{"like": [[1e999,0,0,0,0,0,0,0]]}', b'{"like": [["a"]]}',
        b'{"like": [null]}',
        b'{"like": [[1' + b"0" * 400 + b',0,0,0,0,0,0,0]]}', b'{"like": ["\\ud800:1,1"]}', b'{"text": ["\\ud800"]}',
        b'{"text": "apple"}', b'{"like": ["splat:1"], "extra": 1}', b'{"like": ["splat:1"], "view": "behind"}',
        b'{"like": ["splat:1"], "threshold": NaN}', b'{"like": ["splat:1"], "lift": "x"}', b'{"like": [{"a": 1}]}',
    ],
)  # fmt: skip
def test_no_body_makes_a_query_our_fault(client: TestClient, lift: dict[str, Any], path: str, body: bytes) -> None:
    if body == b'{"like": ["splat:1"], "view": "behind"}' and path in NEED_NO_VIEW:
        return
    reply = client.post(path, content=body, headers={"Content-Type": "application/json"})
    assert 400 <= assert_problem(reply)["status"] < 500


def test_a_tiny_or_huge_vector_has_a_direction_too(client: TestClient, lift: dict[str, Any]) -> None:
    for size in (1e-300, 1e300):
        body = {"like": [(size * codebook()[2].astype(float)).tolist()], "lift": lift["id"]}
        assert of_lamp(client.post("/query", json=body).json())
