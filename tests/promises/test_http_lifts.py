"""Lifts over HTTP: listed, named, looked at, downloaded, brought back and deleted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import liftcore as lc
import numpy as np

from tests.server import Server
from tests.tiny_scene import FOCAL, HEIGHT, SPLATS_A_CLUSTER, VIEWS, WIDTH, WORDS

from .over_http import array, assert_problem, delete_lift, photos_zip, picture, upload

COUNT = 3 * SPLATS_A_CLUSTER


def test_lift_says_what_it_is_and_of_what(client: httpx.Client, lift: dict[str, Any], order: dict[str, Any]) -> None:
    assert (lift["count"], lift["channels"], lift["text_space"], lift["encoder"]) == (COUNT, 8, "tiny", "by hand")
    assert {name: lift[name] for name in ("splats", "cameras", "features")} == {
        name: order[name] for name in ("splats", "cameras", "features")
    }
    assert sorted(lift["views"]) == sorted(VIEWS) and lift["settings"]["preset"] == "row-sum"
    assert lift["diagnostics"]["warnings"] == [] and lift["timings"] and lift["version"] == lc.__version__
    assert client.get(lift["links"]["job"]).json()["links"]["lift"] == lift["links"]["self"] == f"/lifts/{lift['id']}"
    assert lift["id"] in [entry["id"] for entry in client.get("/lifts").json()["lifts"]]
    for name, link in lift["links"].items():
        assert client.get(link + "apple" * (name == "query")).status_code == 200, name


def test_lift_has_the_name_that_somebody_gave_it(client: httpx.Client, lift: dict[str, Any]) -> None:
    path = lift["links"]["self"]
    assert lift["name"] is None
    assert client.patch(path, json={"name": "Kitchen \u2013 Tuesday"}).json()["name"] == "Kitchen \u2013 Tuesday"
    assert client.patch(path, json={}).json()["name"] == "Kitchen \u2013 Tuesday"  # what is left out stays
    for wrong in ("x" * 1001, "two\nlines", 3):
        assert_problem(client.patch(path, json={"name": wrong}), 422)
    assert client.get(path).json()["name"] == "Kitchen \u2013 Tuesday"
    assert client.patch(path, json={"name": None}).json() == lift


def test_downloaded_lift_is_the_file_that_the_library_reads(
    client: httpx.Client, server: Server, lift: dict[str, Any], tmp_path: Path
) -> None:
    reply = client.get(lift["links"]["features"])
    assert len(reply.content) == lift["bytes"] and ".safetensors" in reply.headers["content-disposition"]
    assert str(server.data).encode() not in reply.content  # paths of the server are nobody's business
    (tmp_path / "lift.safetensors").write_bytes(reply.content)
    loaded = lc.load_lift(tmp_path / "lift.safetensors")
    assert loaded.features.shape == (COUNT, 8) and loaded.metadata.text_space == "tiny"


def test_each_splat_has_a_colour_of_its_features(client: httpx.Client, lift: dict[str, Any]) -> None:
    colours = array(client.get(f"/lifts/{lift['id']}/colours", params={"layer": "pca"}).content)
    assert (colours.shape, colours.dtype) == ((COUNT, 3), np.uint8)
    means = colours.reshape(3, SPLATS_A_CLUSTER, 3).mean(axis=1)  # of three words, which lie apart
    assert min(np.abs(means[a] - means[b]).max() for a, b in ((0, 1), (0, 2), (1, 2))) > 60
    for wrong in ("cluster", "magic"):  # this lift has no clusters
        assert assert_problem(client.get(f"/lifts/{lift['id']}/colours", params={"layer": wrong}), 422)["argument"]


def test_views_have_the_cameras_of_their_file(client: httpx.Client, lift: dict[str, Any]) -> None:
    views = client.get(lift["links"]["views"]).json()["views"]
    assert [view["name"] for view in views] == list(VIEWS) and all(view["lifted"] for view in views)
    for view in views:
        assert (view["width"], view["height"], view["fx"]) == (WIDTH, HEIGHT, FOCAL)
        pose = np.array(view["viewmat"])
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], (VIEWS[view["name"]], 0, 0), atol=1e-6)


def test_photos_are_shown_as_they_were_uploaded(client: httpx.Client, lift: dict[str, Any]) -> None:
    content = photos_zip((1, 2, 3))
    photos = upload(client, "photos", content)
    path = lift["links"]["self"]
    assert client.patch(path, json={"photos": photos}).json()["photos"] == photos
    reply = client.get(f"{path}/photo", params={"view": "left"})
    assert reply.content in content and reply.headers["content-type"] == "image/png"  # stored as it is
    assert picture(reply.content).shape == (HEIGHT, WIDTH, 3)
    assert [view["photo"] for view in client.get(f"{path}/views").json()["views"]] == [True, False, False]
    assert_problem(client.get(f"{path}/photo", params={"view": "right"}), 404)
    assert_problem(client.delete(f"/assets/{photos}"), 409)
    assert_problem(client.patch(path, json={"photos": lift["splats"]}))
    assert client.patch(path, json={"photos": None}).json()["photos"] is None
    assert client.delete(f"/assets/{photos}").status_code == 204


def test_objects_are_there_without_words_and_words_name_them(client: httpx.Client, lift: dict[str, Any]) -> None:
    listing = client.get(lift["links"]["objects"]).json()
    assert listing["count"] == 3 and [entry["splats"] for entry in listing["objects"]] == [SPLATS_A_CLUSTER] * 3
    assert {entry["name"] for entry in listing["objects"]} == {None}
    tree = client.get(lift["links"]["tree"]).json()
    assert [node["id"] for node in tree["nodes"]][:3] == [entry["id"] for entry in listing["objects"]]
    names = client.get(lift["links"]["objects"], params={"encoder": "default"}).json()["objects"]
    assert all(entry["name"] == WORDS[round(entry["centre"][0] / 1.2) + 1] for entry in names)


def test_object_takes_a_name_and_is_hidden(client: httpx.Client, lift: dict[str, Any]) -> None:
    path = lift["links"]["objects"]
    view = {"lift": lift["id"], "view": client.get(lift["links"]["views"]).json()["views"][0]["name"]}
    rest = client.get("/render", params=view | {"hide": "object:0"}).content
    before = client.get(path).json()["objects"]
    assert client.patch(f"{path}/0", json={"name": "the mug", "hidden": True}).status_code == 200
    first = client.get(path).json()["objects"][0]
    assert (first["name"], first["hidden"]) == ("the mug", True)
    assert client.get(lift["links"]["tree"]).json()["nodes"][0]["name"] == "the mug"
    assert client.get("/render", params=view).content == rest
    assert client.patch(f"{path}/0", json={"name": None, "hidden": False}).status_code == 200
    assert client.get(path).json()["objects"] == before
    assert client.get("/render", params=view).content != rest
    assert_problem(client.patch(f"{path}/99", json={"hidden": True}), 404)


def test_sizes_are_in_metres_once_a_unit_has_a_length(client: httpx.Client, lift: dict[str, Any]) -> None:
    path, objects = lift["links"]["self"], lift["links"]["objects"]
    before = [entry["size"] for entry in client.get(objects).json()["objects"]]
    world = {"up": [0, -1, 0], "metres_per_unit": 0.25}
    assert client.patch(path, json={"world": world}).json()["world"] == world
    listing = client.get(objects).json()
    assert (listing["unit"], listing["world"]) == ("metres", world)
    np.testing.assert_allclose([entry["size"] for entry in listing["objects"]], np.array(before) / 4)
    for wrong in ({"up": [0, 0, 0]}, {"metres_per_unit": 0}, {"down": [0, 1, 0]}):
        assert_problem(client.patch(path, json={"world": wrong}), 422)
    client.patch(path, json={"world": None})
    assert [entry["size"] for entry in client.get(objects).json()["objects"]] == before


def test_lift_is_brought_without_its_packs_asked_but_for_regions_and_deleted(
    client: httpx.Client, lift: dict[str, Any]
) -> None:
    digest = lift["features"][0].removeprefix("sha256:").encode()
    content = client.get(lift["links"]["features"]).content.replace(digest, b"0" * len(digest))
    reply = client.post("/lifts", content=content)
    assert reply.status_code == 201 and reply.json()["features"] == [], reply.text
    other = reply.json()
    fields = {"lift": other["id"]}
    assert client.get("/query", params=fields | {"text": "lamp"}).json()["count"] > 0
    assert client.post("/query/segment", json=fields).json()["named_words"]
    assert_problem(client.get("/query", params=fields | {"like": "region:left:0:0"}), 422)
    newest, *earlier = [entry["id"] for entry in client.get("/lifts").json()["lifts"]]
    assert newest == other["id"] and lift["id"] in earlier
    selection = client.post(f"/lifts/{other['id']}/selections", json={"name": "mine"}).json()["links"]["self"]
    delete_lift(client, other["id"])
    for name, link in other["links"].items():
        assert_problem(client.get(link + "apple" * (name == "query")), 404)
    assert_problem(client.get(selection), 404)
    assert_problem(client.delete(f"/jobs/{other['id']}"), 404)
    assert client.get(lift["links"]["features"]).status_code == 200
