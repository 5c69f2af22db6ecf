"""Questions over HTTP: words, examples and vectors, and by an answer's links its objects, pictures and splats."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from plyfile import PlyData
from starlette.requests import ClientDisconnect

from liftcore.text.table import TableEncoder
from liftcore.values.pack import write_pack
from liftcore.values.views import Regions
from service import query_worker as answers
from service.content import BINARY, BLOCK_BYTES, Draft
from service.errors import NoSpace
from service.models import AssetKind
from service.query_client import Frame
from service.store.files import DataDirectory
from tests.server import wait_for_end
from tests.tiny_scene import (
    CHANNELS,
    DISTANCE,
    FOCAL,
    HEIGHT,
    POSE,
    SPLATS_A_CLUSTER,
    WIDTH,
    WORDS,
    codebook,
    labels,
    ply,
    splat_rows,
    text_table,
)

from .conftest import SceneAssets, parts_of, put
from .test_problems import assert_problem

LAMP = {"like": f"middle:26,{HEIGHT // 2}", "threshold": 0.5}
PLACES: dict[str, int] = dict(zip(WORDS, (6, 16, 26), strict=True))  # columns of view "middle" that show them
PICTURES = ("/render", "/query/mask", "/query/attention")


def picture(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def array(content: bytes) -> np.ndarray:
    return np.load(io.BytesIO(content), allow_pickle=False)


def rows_of(content: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(content))["vertex"].data


def of_lamp(answer: dict[str, Any]) -> bool:
    rows = {splat["splat"] for splat in answer["top"]}
    return rows <= set(range(2 * SPLATS_A_CLUSTER, 3 * SPLATS_A_CLUSTER)) and answer["count"] > 10


@pytest.mark.parametrize("cluster", range(3))
def test_word_finds_its_cluster_in_numbers_objects_scores_and_a_mask(
    client: TestClient, lift: dict[str, Any], cluster: int
) -> None:
    parameters = {"text": WORDS[cluster], "view": "middle", "threshold": 0.5}
    answer = client.get("/query", params=parameters).json()
    assert answer["lift"] == lift["id"]  # left out of the request: there is only one
    rows = range(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER)
    assert {splat["splat"] for splat in answer["top"]} <= set(rows)
    best = [splat["score"] for splat in answer["top"]]
    assert best == sorted(best, reverse=True)
    assert 0.8 * SPLATS_A_CLUSTER <= answer["count"] <= 1.2 * SPLATS_A_CLUSTER
    assert answer["threshold"]["value"] == 0.5 and answer["threshold"]["method"] == "fixed"
    objects = client.get(answer["links"]["objects"]).json()
    assert (objects["lift"], objects["count"], objects["threshold"]) == (
        lift["id"],
        answer["count"],
        answer["threshold"],
    )
    (entry,) = objects["objects"]
    middle = (cluster - 1) * 1.2
    assert answer["box"]["low"][0] <= entry["box"]["low"][0] < middle < entry["box"]["high"][0]
    assert entry["centre"][0] == pytest.approx(middle, abs=0.2)
    assert entry["splats"] + objects["unassigned_splats"] == objects["count"] and entry["score"] >= 0.5
    scores = array(client.get(answer["links"]["scores"]).content)
    assert (scores.shape, scores.dtype) == ((3 * SPLATS_A_CLUSTER,), np.float32)
    assert scores[answer["top"][0]["splat"]] == pytest.approx(best[0]) == scores.max()
    assert int((scores >= 0.5).sum()) == answer["count"]
    mask = picture(client.get(answer["links"]["mask"]).content)
    assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
    assert abs(np.nonzero(mask)[1].mean() - PLACES[WORDS[cluster]]) < 3


@pytest.mark.parametrize("like", ["middle:26,12", "region:left:0:2", f"splat:{2 * SPLATS_A_CLUSTER}"])
def test_example_finds_more_of_it_and_every_link_leads_somewhere(
    client: TestClient, lift: dict[str, Any], like: str
) -> None:
    answer = client.get("/query", params={"like": like, "view": "middle", "lift": lift["id"]}).json()
    assert of_lamp(answer), answer
    assert (answer["like"], answer["text"], answer["encoder"]) == ([like], [], None)
    for name, link in answer["links"].items():
        assert client.get(link).status_code == 200, name
    assert np.nonzero(picture(client.get(answer["links"]["mask"]).content))[1].min() >= WIDTH // 2


def test_vector_is_asked_by_post_and_so_is_all_that_belongs_to_it(client: TestClient, lift: dict[str, Any]) -> None:
    body = {"like": [codebook()[2].tolist()], "unlike": ["middle:6,12"], "view": "middle", "lift": lift["id"]}
    answer = client.post("/query", json=body).json()
    assert of_lamp(answer) and answer["like"] == [f"a vector of {CHANNELS} channels"]
    assert (answer["links"]["mask"], answer["links"]["object"]) == ("/query/mask", "/query/splats?what=object")
    parameters = {"like": "region:left:0:2", "unlike": "middle:6,12", "lift": lift["id"]}
    by_get = array(client.get("/query/scores", params=parameters).content)
    np.testing.assert_allclose(array(client.post(answer["links"]["scores"], json=body).content), by_get, atol=1e-5)
    assert array(client.post("/query/selection", json=body).content).sum() == answer["count"]
    for name in ("mask", "attention"):
        assert picture(client.post(answer["links"][name], json=body).content).shape[:2] == (HEIGHT, WIDTH)
    objects, coloured = (client.post(answer["links"][name], json=body) for name in ("object", "coloured"))
    assert (len(rows_of(objects.content)), len(rows_of(coloured.content))) == (answer["count"], 3 * SPLATS_A_CLUSTER)
    assert assert_problem(client.post("/query/splats?what=mesh", json=body))["argument"] == "what"
    for size in (1e-300, 1e300):  # it has a direction too
        body = {"like": [(size * codebook()[2].astype(float)).tolist()], "lift": lift["id"]}
        assert of_lamp(client.post("/query", json=body).json())


def test_words_and_examples_make_one_query(client: TestClient, lift: dict[str, Any]) -> None:
    combined = {
        "text": ["apple"],
        "like": ["middle:26,12"],
        "negatives": ["book"],
        "threshold": 0.5,
        "lift": lift["id"],
    }
    by_post, by_get = client.post("/query", json=combined).json(), client.get("/query", params=combined).json()
    assert by_post == by_get
    assert client.get(by_post["links"]["mask"]).status_code == 200
    assert by_post["count"] > 1.5 * SPLATS_A_CLUSTER


def test_answer_says_what_is_known_of_presence(client: TestClient, lift: dict[str, Any]) -> None:
    parameters = {"lift": lift["id"], "text": "lamp"}
    for route in ("/query", "/query/objects"):
        presence = client.get(route, params=parameters).json()
        assert presence["clear"] is True and presence["present"] is None and "200 words" in presence["reason"]
    kept_answer = client.get("/query", params=parameters | {"absent": "keep"}).json()
    assert "absent=keep" in kept_answer["links"]["objects"] and kept_answer["count"] > 0
    empty = client.get("/query", params=parameters | {"negatives": "book", "threshold": 1}).json()
    assert (empty["clear"], empty["count"]) == (False, 0)


def test_absent_word_is_compared_with_other_words_in_numbers(client: TestClient, lift: dict[str, Any]) -> None:
    words = (*WORDS, "boat", "bulb", "light", *(f"word {number}" for number in range(194)))
    rows = np.zeros((len(words), CHANNELS), np.float32)
    rows[:3], rows[3, 2:4], rows[4:6, 2] = (
        codebook(),
        (0.4, 0.9),
        1.0,
    )  # bulb and light are lamps; a boat hardly is one
    rows[4:6, 4:6] = 0.1 * np.eye(2)
    rows[6:, 4:] = np.random.default_rng(3).normal(size=(194, CHANNELS - 4))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    table = client.put("/assets/table", content=text_table(words=words, rows=rows)).json()["id"]
    parameters = {"lift": lift["id"], "table": table}
    for route in ("/query", "/query/objects"):
        absent = client.get(route, params=parameters | {"text": "boat"}).json()
        assert absent["present"] is False
        assert absent["comparison"] == {"nearer": 3, "limit": 1, "count": 200, "nearest": "lamp"}
        present = client.get(route, params=parameters | {"text": "apple"}).json()
        assert present["present"] is True and present["comparison"] is None
    for method in ("auto", "valley", "paper", "otsu", "stability", 0.5):
        answer = client.get("/query", params=parameters | {"text": "apple", "threshold": method}).json()
        assert answer["threshold"]["method"] == (method if isinstance(method, str) else "fixed")
    assert client.delete(f"/assets/{table}").status_code == 204


def test_words_of_a_pack_need_no_encoder_of_the_operator(
    client: TestClient, scene_assets: SceneAssets, tmp_path: Path
) -> None:
    words = TableEncoder("phrases", ["left thing", "right thing"], codebook()[[0, 2]])
    views = {name: Regions(view_labels, codebook()) for name, view_labels in labels().items()}
    write_pack(tmp_path / "pack", views, {"text_space": "prompts"}, table=words)
    pack = put(client, AssetKind.FEATURES, (tmp_path / "pack").read_bytes())
    job = wait_for_end(
        client, client.post("/lift", json=scene_assets.order() | {"features": [pack]}).headers["location"]
    )
    lift = client.get(job["links"]["lift"]).json()
    assert (lift["text_space"], lift["words"]) == ("prompts", ["left thing", "right thing"])
    for text in ("Left_thing", "right thing"):
        answer = client.get("/query", params={"lift": lift["id"], "text": text, "top": 1}).json()
        assert (answer["count"], answer["clear"], answer["encoder"]) == (20, True, "prompts")
        assert (answer["top"][0]["splat"] < 20) == (text == "Left_thing")
    problem = assert_problem(client.get("/query", params={"lift": lift["id"], "text": "apple"}))
    assert problem["status"] == 422 and "the lift's own words" in problem["detail"]
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(f"/assets/{pack}").status_code == 204


# Pictures and their tags


@pytest.mark.parametrize("path", PICTURES)
def test_picture_has_the_size_of_its_view_and_a_tag(client: TestClient, lift: dict[str, Any], path: str) -> None:
    params = {"lift": lift["id"], "view": "left"} | ({} if path == "/render" else {"text": "apple"})
    reply = client.get(path, params=params)
    assert reply.headers["content-type"] == "image/png" and picture(reply.content).shape[:2] == (HEIGHT, WIDTH)
    for etag in (reply.headers["etag"], "*"):  # any picture at all is one that exists
        second = client.get(path, params=params, headers={"If-None-Match": etag})
        assert (second.status_code, second.content, second.headers["etag"]) == (304, b"", reply.headers["etag"])
    other = client.get(path, params=params | {"view": "right"}, headers={"If-None-Match": reply.headers["etag"]})
    assert other.status_code == 200
    empty = client.get(path, params=params | {"view": "behind"}, headers={"If-None-Match": "*"})
    assert assert_problem(empty)["status"] == 404


def test_every_question_has_a_tag_of_its_own(client: TestClient, lift: dict[str, Any]) -> None:
    def tag(path: str = "/query/mask", **extra: Any) -> str:
        params = {"like": "middle:26,12", "lift": lift["id"]} | ({"view": "middle"} if "mask" in path else {}) | extra
        reply = client.get(path, params=params)
        second = client.get(path, params=params, headers={"If-None-Match": reply.headers["etag"]})
        assert (reply.status_code, second.status_code, second.content) == (200, 304, b"")
        return reply.headers["etag"]

    changes: list[dict[str, Any]] = [
        {}, {"like": "middle:25,12"}, {"unlike": "middle:6,12"}, {"keep": "largest"}, {"instances": 2},
        {"text": "lamp"}, {"path": "/query/splats", "what": "object"}, {"path": "/query/splats", "what": "scores"},
        {"path": "/query/scores"}, {"path": "/query/selection"},
    ]  # fmt: skip
    assert len({tag(**change) for change in changes}) == len(changes)


def test_render_shows_colours_features_or_depth(client: TestClient, lift: dict[str, Any]) -> None:
    parameters = {"lift": lift["id"], "view": "middle"}
    colours, features, depth = (
        client.get("/render", params=parameters | {"channel": channel}) for channel in ("rgb", "pca", "depth")
    )
    assert len({reply.headers["etag"] for reply in (colours, features, depth)}) == 3
    assert picture(features.content).shape == picture(colours.content).shape == (HEIGHT, WIDTH, 3)
    assert (picture(features.content) != picture(colours.content)).any()
    with Image.open(io.BytesIO(depth.content)) as depth_image:
        assert (depth_image.size, depth_image.mode) == ((WIDTH, HEIGHT), "L")
        near, far = (float(depth_image.info[name]) for name in ("depth-near", "depth-far"))
    assert DISTANCE - 0.5 < near < far < DISTANCE + 0.5
    lacking = assert_problem(client.get("/render", params=parameters | {"channel": "cluster"}))
    assert lacking["type"] == "/problems/invalid-query" and "aggregation" in lacking["detail"]


def test_camera_of_no_file_sees_what_a_view_sees(client: TestClient, lift: dict[str, Any]) -> None:
    """The same pose gives the same picture, and an entry of the list of views is a camera."""
    own_camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "viewmat": POSE}
    views_by_name = {view["name"]: view for view in client.get(f"/lifts/{lift['id']}/views").json()["views"]}
    for path in PICTURES:
        parameters = {"lift": lift["id"]} | ({} if path == "/render" else {"text": ["lamp"]})
        by_name = client.post(path, json=parameters | {"view": "middle"}).content
        for camera in (own_camera, views_by_name["middle"]):
            assert (
                picture(client.post(path, json=parameters | {"camera": camera}).content) == picture(by_name)
            ).all()


# Splats, and what is too large for the pipe


def drafts(client: TestClient) -> list[Path]:
    return list((parts_of(client).store.files.root / "tmp").iterdir())


def test_object_is_the_rows_that_were_found_to_the_byte(client: TestClient, lift: dict[str, Any]) -> None:
    answer = client.get("/query", params={**LAMP, "lift": lift["id"]}).json()
    scores = array(client.get(answer["links"]["scores"]).content)
    reply = client.get(answer["links"]["object"])
    assert reply.content == ply(splat_rows()[scores >= 0.5])
    assert reply.headers["content-type"] == "application/octet-stream"
    assert reply.headers["content-disposition"] == f'attachment; filename="object-{lift["id"]}.ply"'
    assert int(reply.headers["content-length"]) == len(reply.content)
    assert not drafts(client)


def test_nothing_found_is_a_problem_that_says_what_to_try(client: TestClient, lift: dict[str, Any]) -> None:
    params = {**LAMP, "negatives": "book", "threshold": 1, "lift": lift["id"]}
    assert "object" not in client.get("/query", params=params).json()["links"]
    problem = assert_problem(client.get("/query/splats", params=params))
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-query")
    assert "nothing stands out" in problem["got"] and "threshold" in problem["hint"]
    assert len(rows_of(client.get("/query/splats", params=params | {"what": "scores"}).content)) == 60
    assert not drafts(client)


def test_too_little_disk_is_said_before_anything_is_made(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DataDirectory, "free_bytes", lambda files: 0)
    parameters = {**LAMP, "lift": lift["id"]}
    assert assert_problem(client.get("/query/splats", params=parameters))["type"] == "/problems/no-space"
    assert client.get("/query", params=parameters).status_code == 200


def test_large_array_is_sent_from_a_file(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = bytes(3 * BLOCK_BYTES + 7)

    def call(request: dict[str, Any], waiter: object) -> Frame:
        Path(request["draft"]).write_bytes(content)
        return Frame({})

    monkeypatch.setattr(parts_of(client).query_client, "call", call)
    for reply in (
        client.get("/query/scores", params=LAMP | {"lift": lift["id"]}),
        client.post("/query/scores", json={"text": ["lamp"], "lift": lift["id"]}),
        client.get(f"/lifts/{lift['id']}/colours"),
    ):
        assert reply.content == content and reply.headers["content-type"] == "application/x-npy"
        assert "content-disposition" not in reply.headers
    assert not drafts(client)


def test_disk_that_fills_up_meanwhile_is_no_fault_of_ours() -> None:
    with pytest.raises(NoSpace):
        answers.write_draft([b"x"], Path("/dev/full"))
    with pytest.raises(IsADirectoryError):
        answers.write_draft([b"x"], Path("/dev"))


@pytest.mark.parametrize("leaves", [False, True], ids=["reads", "leaves"])
def test_draft_is_sent_without_its_name_and_closed_however_that_ends(tmp_path: Path, leaves: bool) -> None:
    content = np.random.default_rng(0).bytes(3 * BLOCK_BYTES + 17)
    (tmp_path / "draft").write_bytes(content)
    reply = Draft(tmp_path / "draft", BINARY, filename="object.ply", headers={})
    (tmp_path / "draft").unlink()
    frames: list[bytes] = []

    async def send(message: Any) -> None:
        frames.append(message.get("body", b""))
        if leaves and len(frames) == 3:
            raise OSError("gone")

    async def receive() -> Any:
        await anyio.sleep_forever()

    with pytest.raises(ClientDisconnect) if leaves else contextlib.nullcontext():
        anyio.run(reply, {"type": "http", "asgi": {"spec_version": "2.4"}}, receive, send)
    assert reply.file.closed
    assert max(map(len, frames)) == BLOCK_BYTES
    assert leaves or b"".join(frames) == content


# What is refused


@pytest.mark.parametrize(
    ("path", "parameters", "status", "argument"),
    [
        ("/query", {}, 422, "query"),
        ("/query", {"text": ""}, 422, "text.0"),
        ("/query", {"text": "apple", "negatives": " "}, 422, "negatives.0"),
        ("/query", {"text": ["apple", "zeppelin"], "negatives": "lamp"}, 422, "text.1"),
        ("/query", {"text": "apple", "negatives": ["lamp", "zeppelin"], "like": "splat:1"}, 422, "negatives.1"),
        ("/query", {"unlike": ["splat:2", "behind:1,1"], "like": "splat:1"}, 404, "unlike.1"),
        ("/query", {"like": ["splat:1", "splat:60"], "text": "apple"}, 422, "like.1"),
        ("/query", {"like": "middle:0,0"}, 422, "like.0"),
        ("/query", {"like": "a\ufffd:1,1"}, 404, "like.0"),
        ("/query", {"like": "region:left:7:0"}, 404, "like.0"),
        ("/query", {"like": ["splat:1"] * 33}, 422, "like"),
        ("/query", {"like": "splat:1", "instances": 0}, 422, "instances"),
        ("/query", {"text": "apple", "lift": "0" * 32}, 404, "lift"),
        ("/query", {"text": "apple", "view": "behind"}, 404, "view"),
        ("/query", {"text": "apple", "top": -1}, 422, "top"),
        ("/query", {"text": "apple", "absent": "hide"}, 422, "absent"),
        ("/query", {"text": "apple", "weight_by": "confidence"}, 422, "weight_by"),  # this lift was not reweighted
        ("/query", {"text": "apple", "encoder": "table:/etc/passwd"}, 422, "encoder"),
        ("/query", {"text": "apple", "encoder": "spare"}, 422, "encoder"),  # 5 channels and not 8
        ("/query/mask", {"text": "apple"}, 422, "view"),
        ("/query/scores", {"text": "apple", "lift": "../../etc/passwd"}, 422, "lift"),
        ("/query/splats", {"text": "apple", "what": "mesh"}, 422, "what"),
        ("/render", {"view": "left", "channel": "x-rays"}, 422, "channel"),
    ],
)
def test_question_that_leads_nowhere_names_what_is_wrong(
    client: TestClient, lift: dict[str, Any], path: str, parameters: dict[str, Any], status: int, argument: str
) -> None:
    problem = assert_problem(client.get(path, params={"lift": lift["id"]} | parameters))
    assert (problem["status"], problem.get("argument")) == (status, argument), problem


@pytest.mark.parametrize(
    ("path", "body", "argument"),
    [
        ("/query/mask", {"text": ["lamp"]}, "view"),
        ("/query/mask", {"text": ["lamp"], "camera": {}}, "camera.width"),
        ("/query/mask", {"text": ["lamp"], "camera": {"fx": 0}}, "camera 'camera' intrinsics"),
        ("/query/mask", {"text": ["lamp"], "camera": {"viewmat": np.zeros((4, 4)).tolist()}}, "camera 'camera' pose"),
        ("/query/mask", {"text": ["lamp"], "camera": {"viewmat": [[1, 0, 0, 0]] * 3}}, "camera.viewmat"),
        ("/render", {"view": "middle", "camera": {"fx": FOCAL}}, "view"),
        ("/render", {"view": "middle", "channel": "confidence"}, "channel"),
        ("/query/segment", {"words": []}, "words"),
        ("/query/segment", {"words": ["lamp", "lamp"]}, "words"),
        ("/query/segment", {"words": ["zeppelin"]}, "text"),
        ("/query/segment/map", {}, "view"),
        ("/query/what", {"example": "middle:99,0"}, "middle:99,0"),
    ],
)
def test_body_that_cannot_be_answered_names_what_is_wrong(
    client: TestClient, lift: dict[str, Any], path: str, body: dict[str, Any], argument: str
) -> None:
    if body.get("camera"):
        body = body | {"camera": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "viewmat": POSE} | body["camera"]}
    problem = assert_problem(client.post(path, json={"lift": lift["id"]} | body))
    assert (problem["status"], problem.get("argument")) == (422, argument), problem


# Many words at once, and those of an uploaded table


@pytest.fixture(scope="module")
def own_table(client: TestClient) -> str:
    """A table of other names for the three things, and of one that is not there."""
    names = ("fruit", "novel", "light", "boat")
    content = text_table(words=names, rows=np.eye(4, CHANNELS, dtype=np.float32))
    return client.put("/assets/table", content=content).json()["id"]


def test_every_splat_gets_its_word_of_the_table(client: TestClient, lift: dict[str, Any], own_table: str) -> None:
    body = {"lift": lift["id"], "table": own_table, "view": "middle"}
    answer = client.post("/query/segment", json=body).json()
    words_by_name = {word["word"]: word for word in answer["found"]}
    assert (set(words_by_name), answer["words"], answer["encoder"]) == ({"fruit", "novel", "light"}, 4, "table")
    assert words_by_name["fruit"]["box"]["high"][0] < words_by_name["novel"]["box"]["low"][0]
    labels = array(client.post("/query/segment/labels", json=body).content)
    assert (labels == 0).sum() == answer["none"]
    last_labels = labels[2 * SPLATS_A_CLUSTER :]
    assert set(last_labels.tolist()) - {0} == {words_by_name["light"]["value"]}
    label_map = Image.open(io.BytesIO(client.post("/query/segment/map", json=body).content))
    legend = json.loads(label_map.text["legend"])  # pyright: ignore[reportAttributeAccessIssue]: of a PNG
    values = np.asarray(label_map)[HEIGHT // 2]
    assert [legend[str(values[column])] for column in PLACES.values()] == ["fruit", "novel", "light"]
    assert picture(client.post("/query/segment/picture", json=body).content).shape[1] > WIDTH


@pytest.mark.parametrize("word", WORDS)
def test_what_this_is_names_the_nearest_words(client: TestClient, lift: dict[str, Any], word: str) -> None:
    for example in (f"middle:{PLACES[word]},12", f"splat:{SPLATS_A_CLUSTER * WORDS.index(word)}"):
        body = {"lift": lift["id"], "example": example, "top": 2}
        best = client.post("/query/what", json=body).json()["words"]
        assert best[0]["word"] == word and best[0]["score"] > best[1]["score"]


def test_texts_are_asked_as_words_and_others_are_refused_with_those_that_can_be(
    client: TestClient, lift: dict[str, Any], own_table: str
) -> None:
    parameters = {"lift": lift["id"], "table": own_table}
    answer = client.get("/query", params=parameters | {"text": "two old lights"}).json()
    assert answer["wording"] == [{"text": "two old lights", "word": "light", "match": "head", "how": "head"}]
    assert client.get("/query", params=parameters | {"text": "light"}).json()["wording"] == []
    problem = assert_problem(client.get("/query", params=parameters | {"text": "boaat"}))
    assert (problem["argument"], problem["nearest"]) == ("text.0", ["boat"])
    words = client.get("/query/words", params=parameters | {"text": "no"}).json()
    assert (words["open_vocabulary"], words["words"]) == (False, [{"word": "novel", "typed": "novel"}])
    assert "nearest" not in assert_problem(client.get("/query/words", params=parameters | {"lift": "0" * 32}))
    for vocabulary in ({}, {"table": own_table}, {"encoder": "default"}):  # no name of a file of the server
        refusal = assert_problem(client.get("/query", params={"lift": lift["id"], "text": "boaat"} | vocabulary))
        assert refusal["nearest"] and ".safetensors" not in refusal["detail"]


def test_words_that_come_with_an_order_are_those_of_the_lift(
    client: TestClient, scene_assets: SceneAssets, own_table: str
) -> None:
    job = wait_for_end(
        client, client.post("/lift", json=scene_assets.order() | {"table": own_table}).headers["location"]
    )
    parameters = {"lift": job["id"], "text": "fruit"}
    assert client.get("/query", params=parameters).json()["present"] is not False
    assert client.get("/query/words", params=parameters).json()["words"][0]["word"] == "fruit"
    assert set(client.get("/query/words", params={"lift": job["id"]}).json()["here"]) == {"fruit", "novel", "light"}
    assert assert_problem(client.get("/query", params=parameters | {"encoder": "default"}))["nearest"]
    assert client.delete(f"/assets/{own_table}").status_code == 409
    narrow = client.put("/assets/table", content=text_table(CHANNELS - 1)).json()["id"]
    wrong = client.post("/lift", json=scene_assets.order() | {"table": narrow})
    assert assert_problem(wrong)["argument"] == "table"
    assert client.delete(f"/jobs/{job['id']}?with_lift=true").status_code == 204


def test_an_uploaded_table_answers_questions(client: TestClient, lift: dict[str, Any], own_table: str) -> None:
    parameters = {"lift": lift["id"], "text": "light", "table": own_table, "view": "middle"}
    answer = client.get("/query", params=parameters).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {2}
    for link in answer["links"].values():
        assert client.get(link).status_code == 200
    for wrong, status in ((lift["splats"], 422), ("sha256:" + "0" * 64, 404)):
        assert assert_problem(client.get("/query", params=parameters | {"table": wrong}))["status"] == status
    assert assert_problem(client.get("/query", params=parameters | {"encoder": "default"}))["argument"] == "table"
