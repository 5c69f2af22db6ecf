"""The main job over HTTP: upload, lift, query, pictures."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from liftcore.query.scene import QueryScene

from .conftest import Uploaded
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import (
    CHANNELS,
    DISTANCE,
    HEIGHT,
    SPLATS_A_CLUSTER,
    VIEWS,
    WIDTH,
    WORDS,
    TinyScene,
    cameras_document,
    colmap_zip,
    labels,
    pack,
)

COUNT = 3 * SPLATS_A_CLUSTER


def picture(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_assets_say_what_is_in_them(client: TestClient, uploaded: Uploaded) -> None:
    splats = client.get(f"/assets/{uploaded.splats}").json()
    assert (splats["kind"], splats["counts"]["splats"], splats["counts"]["kernel"]) == (
        "splats",
        COUNT,
        "3dgs",
    )
    cameras = client.get(f"/assets/{uploaded.cameras}").json()
    assert cameras["counts"]["views"] == len(VIEWS)
    features = client.get(f"/assets/{uploaded.features}").json()
    assert (features["counts"]["channels"], features["counts"]["text_space"]) == (CHANNELS, "tiny")
    listed = {asset["id"] for asset in client.get("/assets").json()["assets"]}
    assert {uploaded.splats, uploaded.cameras, uploaded.features} <= listed


def test_job_tells_its_story(client: TestClient, lift: dict[str, Any], uploaded: Uploaded) -> None:
    job = client.get(lift["links"]["job"]).json()
    assert (job["state"], job["attempt"], job["problem"]) == ("succeeded", 1, None)
    assert job["splats"] == uploaded.splats and job["features"] == [uploaded.features]
    assert job["settings"]["preset"] == "row-sum" and job["settings"]["power"] == 1
    assert job["created"] <= job["started"] <= job["ended"]
    progress = job["progress"]
    assert progress["done"] == progress["total"] and progress["unit"]
    assert job["id"] in {found["id"] for found in client.get("/jobs").json()["jobs"]}


def test_lift_tells_how_far_to_trust_it(client: TestClient, lift: dict[str, Any]) -> None:
    assert (lift["count"], lift["channels"]) == (COUNT, CHANNELS)
    assert sorted(lift["views"]) == sorted(VIEWS)
    assert lift["text_space"] == "tiny" and lift["certificate"] and lift["timings"]
    assert "/" not in lift["splats"]
    assert lift in client.get("/lifts").json()["lifts"]


def test_lift_file_is_downloaded_whole_and_in_parts(client: TestClient, lift: dict[str, Any]) -> None:
    whole = client.get(lift["links"]["features"])
    assert whole.status_code == 200 and len(whole.content) == lift["bytes"]
    assert whole.headers["etag"] == f'"{lift["sha256"]}"'
    part = client.get(lift["links"]["features"], headers={"Range": "bytes=8-15"})
    assert part.status_code == 206 and part.content == whole.content[8:16]
    tag = {"If-None-Match": whole.headers["etag"]}
    assert client.get(lift["links"]["features"], headers=tag).status_code == 304


def test_lift_and_its_files_are_found_where_they_were_downloaded(
    client: TestClient, data: Path, lift: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [f"/assets/{asset}/content" for asset in (lift["splats"], lift["cameras"], *lift["features"])]
    for link in (lift["links"]["features"], *files):
        reply = client.get(link)
        name = reply.headers["content-disposition"].partition('filename="')[2].rstrip('"')
        (tmp_path / name).write_bytes(reply.content)
    [made] = tmp_path.glob("lift-*.safetensors")
    assert str(data).encode() not in made.read_bytes()  # paths of the server are nobody's business
    monkeypatch.chdir(tmp_path)
    scene = QueryScene.open(made)
    assert scene.splats.count == COUNT and {camera.name for camera in scene.cameras.values()} == set(VIEWS)
    assert set(scene.packs.views) == set(VIEWS)


def test_views_that_meet_no_label_or_no_splat_do_not_end_a_lift(start: Callable[..., Any], scene: TinyScene) -> None:
    away = cameras_document()
    turned = np.array(away["frames"][0]["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    away["frames"][0]["transform_matrix"] = turned.tolist()  # it looks along +z, where nothing is
    blank = labels()
    blank["right"] = np.full_like(blank["right"], -1)
    with start() as client:
        ids = [
            client.put(f"/assets/{kind}", content=content).json()["id"]
            for kind, content in (
                ("splats", scene.splats), ("cameras", json.dumps(away).encode()), ("features", pack(blank)),
            )
        ]  # fmt: skip
        job = ended(client, client.post("/lift", json=Uploaded(*ids).order()).headers["location"])
        assert (job["state"], job["attempt"]) == ("succeeded", 1), job
        found = client.get(job["links"]["lift"]).json()
        assert any("meet no splat" in warning for warning in found["certificate"]["warnings"])


@pytest.mark.parametrize("cluster", range(3))
def test_query_finds_the_cluster_of_the_word(client: TestClient, lift: dict[str, Any], cluster: int) -> None:
    answer = client.get("/query", params={"text": WORDS[cluster], "view": "middle", "threshold": 0.5}).json()
    assert answer["lift"] == lift["id"]  # left out of the request: there is only one
    rows = range(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER)
    assert {splat["splat"] for splat in answer["top"]} <= set(rows)
    assert [splat["score"] for splat in answer["top"]] == sorted(
        (splat["score"] for splat in answer["top"]), reverse=True
    )
    assert 0.8 * SPLATS_A_CLUSTER <= answer["count"] <= 1.2 * SPLATS_A_CLUSTER
    found = client.get(answer["links"]["objects"]).json()
    assert (found["lift"], found["count"], found["threshold"]) == (lift["id"], answer["count"], answer["threshold"])
    (thing,) = found["objects"]
    middle = (cluster - 1) * 1.2
    assert answer["box"]["low"][0] < middle < answer["box"]["high"][0]
    assert thing["box"]["low"][0] < middle < thing["box"]["high"][0]
    assert thing["centre"][0] == pytest.approx(middle, abs=0.2)
    assert all(low <= inner for low, inner in zip(answer["box"]["low"], thing["box"]["low"], strict=True))
    assert thing["splats"] + found["strays"] == found["count"]
    assert 0 < thing["share"] <= 1 and thing["score"] >= 0.5
    assert answer["threshold"] == {"value": 0.5, "method": "fixed"} | {
        "explanation": answer["threshold"]["explanation"]
    }


def test_scores_are_one_float_a_splat(client: TestClient, lift: dict[str, Any]) -> None:
    answer = client.get("/query", params={"text": "book", "lift": lift["id"], "threshold": 0.5}).json()
    reply = client.get(answer["links"]["scores"])
    scores = np.load(io.BytesIO(reply.content), allow_pickle=False)
    assert scores.shape == (COUNT,) and scores.dtype == np.float32
    best = answer["top"][0]
    assert scores[best["splat"]] == pytest.approx(best["score"]) and scores.max() == pytest.approx(best["score"])
    assert int((scores >= 0.5).sum()) == answer["count"]


def test_mask_lies_where_the_word_is(client: TestClient, lift: dict[str, Any]) -> None:
    params = {"text": "lamp", "lift": lift["id"], "view": "middle", "threshold": 0.5}
    reply = client.get("/query/mask", params=params)
    assert reply.headers["content-type"] == "image/png"
    mask = picture(reply.content)
    assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
    columns = np.nonzero(mask)[1]
    assert columns.min() >= WIDTH // 2  # the lamp is the cluster on the right


@pytest.mark.parametrize("path", ["/query/attention", "/query/mask", "/render"])
def test_pictures_have_the_size_of_the_view_and_a_tag(client: TestClient, lift: dict[str, Any], path: str) -> None:
    params = {"lift": lift["id"], "view": "left"} | ({} if path == "/render" else {"text": "apple"})
    reply = client.get(path, params=params)
    assert reply.status_code == 200, reply.text
    assert picture(reply.content).shape[:2] == (HEIGHT, WIDTH)
    again = client.get(path, params=params, headers={"If-None-Match": reply.headers["etag"]})
    assert again.status_code == 304 and again.content == b""
    other = client.get(path, params=params | {"view": "right"}, headers={"If-None-Match": reply.headers["etag"]})
    assert other.status_code == 200


def test_features_are_shown_as_colours(client: TestClient, lift: dict[str, Any]) -> None:
    params = {"lift": lift["id"], "view": "middle"}
    plain = picture(client.get("/render", params=params).content)
    features = client.get("/render", params=params | {"what": "pca"})
    shown = picture(features.content)
    assert features.status_code == 200 and shown.shape == plain.shape == (HEIGHT, WIDTH, 3)
    assert (shown != plain).any() and shown.max() > 128


def test_depth_is_grey_and_tells_its_range(client: TestClient, lift: dict[str, Any]) -> None:
    reply = client.get("/render", params={"lift": lift["id"], "view": "middle", "what": "depth"})
    with Image.open(io.BytesIO(reply.content)) as shown:
        assert (shown.size, shown.mode) == ((WIDTH, HEIGHT), "L")
        near, far = (float(shown.info[name]) for name in ("depth-near", "depth-far"))
    assert DISTANCE - 0.5 < near < far < DISTANCE + 0.5
    plain = client.get("/render", params={"lift": lift["id"], "view": "middle"})
    assert plain.headers["etag"] != reply.headers["etag"]


def test_clusters_of_a_lift_without_aggregation_are_a_problem_that_says_so(
    client: TestClient, lift: dict[str, Any]
) -> None:
    reply = client.get("/render", params={"lift": lift["id"], "view": "middle", "what": "cluster"})
    assert reply.status_code == 422 and reply.json()["type"].endswith("invalid-query")
    assert "aggregation" in reply.json()["detail"]


def test_negatives_change_the_scores(client: TestClient, lift: dict[str, Any]) -> None:
    params = {"text": "apple", "lift": lift["id"]}
    plain = client.get("/query/scores", params=params).content
    against = client.get("/query/scores", params=params | {"negatives": ["book", "lamp"]})
    assert against.status_code == 200 and against.content != plain


def test_links_of_an_answer_lead_somewhere(client: TestClient, lift: dict[str, Any]) -> None:
    answer = client.get("/query", params={"text": "apple", "negatives": ["book"]}).json()
    for name, link in answer["links"].items():
        assert client.get(link).status_code == 200, name


def test_colmap_cameras_come_as_a_zip(client: TestClient, uploaded: Uploaded) -> None:
    reply = client.put("/assets/cameras", content=colmap_zip())
    assert reply.status_code == 201, reply.text
    assert reply.json()["counts"]["names"] == list(VIEWS)
    assert client.delete(reply.json()["links"]["self"]).status_code == 204


PICTURES = ("/render", "/query/mask", "/query/attention")


@pytest.mark.parametrize("path", PICTURES)
def test_any_picture_is_one_that_exists(client: TestClient, lift: dict[str, Any], path: str) -> None:
    asked = {"lift": lift["id"], "view": "left"} | ({} if path == "/render" else {"text": "apple"})
    any_at_all = {"If-None-Match": "*"}
    nothing = client.get(path, params=asked | {"view": "behind"}, headers=any_at_all)
    assert assert_problem(nothing)["status"] == 404
    there = client.get(path, params=asked, headers=any_at_all)
    assert (there.status_code, there.content) == (304, b"")
    assert there.headers["etag"] == client.get(path, params=asked).headers["etag"]


def test_document_says_what_is_answered_beside_200(client: TestClient, uploaded: Uploaded) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    files = ("/assets/{asset}/content", "/lifts/{lift}/features")
    for path in (
        *files,
        *PICTURES,
        "/query/scores",
        "/lifts/{lift}/splats",
        "/lifts/{lift}/colours",
        "/tradeoffs/{tradeoff}/chart",
    ):
        told = paths[path]["get"]["responses"]
        assert "304" in told and "content" not in told["304"], path
        assert ("206" in told, "416" in told) == (path in files, path in files), path
        assert list(told["200"]["content"]), path
    for path in files:
        told = paths[path]["get"]["responses"]
        assert list(told["206"]["content"]) == list(told["200"]["content"]) == ["application/octet-stream"]
        assert list(told["416"]["content"]) == ["application/problem+json"]
    assert "304" not in paths["/query/mask"]["post"]["responses"]
