"""Lifts over HTTP: listed, named, looked at, downloaded, brought back and deleted."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import httpx
import liftcore as lc
import numpy as np
import pytest
from PIL import Image

from tests.server import Server
from tests.tiny_scene import FOCAL, HEIGHT, SPLATS_A_CLUSTER, VIEWS, WIDTH, WORDS, TinyScene, splat_rows

from .over_http import NO_ID, array, assert_problem, delete_lift, lift_of, picture, upload

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
    for path in ("", "/features", "/objects", "/tree", "/views", "/splats", "/selections"):
        assert_problem(client.get(f"/lifts/{NO_ID}{path}"), 404)
    assert_problem(client.get("/lifts/..%2f..%2fetc%2fpasswd"))


def test_lift_has_the_name_that_somebody_gave_it(client: httpx.Client, lift: dict[str, Any]) -> None:
    path = lift["links"]["self"]
    assert lift["name"] is None
    assert client.patch(path, json={"name": "Kitchen \u2013 Tuesday"}).json()["name"] == "Kitchen \u2013 Tuesday"
    assert client.patch(path, json={}).json()["name"] == "Kitchen \u2013 Tuesday"  # what is left out stays
    for wrong in ("x" * 1001, "two\nlines", 3):
        assert_problem(client.patch(path, json={"name": wrong}), 422)
    assert client.get(path).json()["name"] == "Kitchen \u2013 Tuesday"
    assert client.patch(path, json={"name": None}).json() == lift
    assert_problem(client.patch(f"/lifts/{NO_ID}", json={"name": "x"}), 404)


def test_downloaded_lift_is_the_file_that_the_library_reads(
    client: httpx.Client, server: Server, lift: dict[str, Any], tmp_path: Path
) -> None:
    reply = client.get(lift["links"]["features"])
    assert len(reply.content) == lift["bytes"] and ".safetensors" in reply.headers["content-disposition"]
    assert str(server.data).encode() not in reply.content  # paths of the server are nobody's business
    (tmp_path / "lift.safetensors").write_bytes(reply.content)
    loaded = lc.load_lift(tmp_path / "lift.safetensors")
    assert loaded.features.shape == (COUNT, 8) and loaded.metadata.text_space == "tiny"
    part = client.get(lift["links"]["features"], headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, reply.content[100:200])


def test_answers_of_a_downloaded_lift_are_those_of_the_service(
    client: httpx.Client, lift: dict[str, Any], tiny: TinyScene, tmp_path: Path
) -> None:
    files = {"lift.safetensors": client.get(lift["links"]["features"]).content}
    files |= {"s.ply": tiny.splats, "c.json": tiny.cameras, "t.safetensors": tiny.table}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    scene = lc.Scene(tmp_path / "lift.safetensors", tmp_path / "s.ply", tmp_path / "c.json")
    answer = scene.ask(lc.Query(text=["lamp"]), encoder=f"table:{tmp_path}/t.safetensors")
    other = client.get("/query", params={"lift": lift["id"], "text": "lamp"}).json()
    assert (other["count"], other["threshold"]["value"]) == (answer.count, answer.threshold.value)


def test_splats_for_a_viewer_are_in_the_rows_of_the_lift(client: httpx.Client, lift: dict[str, Any]) -> None:
    content = client.get(f"/lifts/{lift['id']}/splats").content
    assert len(content) == 32 * COUNT  # .splat: means and scales as f32, colour and turn as u8
    floats, octets = np.frombuffer(content, "<f4").reshape(COUNT, 8), np.frombuffer(content, np.uint8)
    rows = splat_rows()
    np.testing.assert_array_equal(floats[:, :3], rows[:, :3])
    np.testing.assert_allclose(floats[:, 3:6], np.exp(rows[:, 7:10]), rtol=1e-6)
    colours = octets.reshape(COUNT, 32)[:, 24:28] / 255
    np.testing.assert_allclose(colours[:, :3], np.clip(0.5 + 0.282095 * rows[:, 3:6], 0, 1), atol=3e-3)
    np.testing.assert_allclose(colours[:, 3], 1 / (1 + np.exp(-rows[:, 6])), atol=3e-3)


def test_each_splat_has_a_colour_of_its_features(client: httpx.Client, lift: dict[str, Any]) -> None:
    colours = array(client.get(f"/lifts/{lift['id']}/colours", params={"what": "pca"}).content)
    assert (colours.shape, colours.dtype) == ((COUNT, 3), np.uint8)
    means = colours.reshape(3, SPLATS_A_CLUSTER, 3).mean(axis=1)  # of three words, which lie apart
    assert min(np.abs(means[a] - means[b]).max() for a, b in ((0, 1), (0, 2), (1, 2))) > 60
    for wrong in ("cluster", "magic"):  # this lift has no clusters
        assert assert_problem(client.get(f"/lifts/{lift['id']}/colours", params={"what": wrong}), 422)["argument"]


def test_views_have_the_cameras_of_their_file(client: httpx.Client, lift: dict[str, Any]) -> None:
    views = client.get(lift["links"]["views"]).json()["views"]
    assert [view["name"] for view in views] == list(VIEWS) and all(view["lifted"] for view in views)
    for view in views:
        assert (view["width"], view["height"], view["fx"]) == (WIDTH, HEIGHT, FOCAL)
        pose = np.array(view["viewmat"])
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], (VIEWS[view["name"]], 0, 0), atol=1e-6)


@pytest.mark.parametrize("channel", ["rgb", "pca", "depth"])
def test_render_has_the_size_of_its_view(client: httpx.Client, lift: dict[str, Any], channel: str) -> None:
    parameters = {"lift": lift["id"], "view": "left", "channel": channel}
    reply = client.get("/render", params=parameters)
    assert reply.headers["content-type"] == "image/png" and picture(reply.content).shape[:2] == (HEIGHT, WIDTH)
    (view, *_) = client.get(lift["links"]["views"]).json()["views"]
    body = {"lift": lift["id"], "camera": view, "channel": channel}
    assert (picture(client.post("/render", json=body).content) == picture(reply.content)).all()
    other = client.get("/render", params=parameters | {"view": "right"})
    assert (picture(other.content) != picture(reply.content)).any()
    assert_problem(client.get("/render", params=parameters | {"view": "behind"}), 404)
    assert (
        assert_problem(client.get("/render", params=parameters | {"channel": "x-rays"}), 422)["argument"] == "channel"
    )


def test_photos_are_shown_as_they_were_uploaded(client: httpx.Client, lift: dict[str, Any]) -> None:
    photo, content = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (1, 2, 3)).save(photo, "PNG")
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("images/left.png", photo.getvalue())
    photos = upload(client, "photos", content.getvalue())
    path = lift["links"]["self"]
    assert client.patch(path, json={"photos": photos}).json()["photos"] == photos
    reply = client.get(f"{path}/photo", params={"view": "left"})
    assert (reply.content, reply.headers["content-type"]) == (photo.getvalue(), "image/png")
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
    for entry in names:
        middle = entry["centre"][0]
        assert entry["name"] == WORDS[round(middle / 1.2) + 1] and entry["score"] > 0.9
        assert entry["box"]["low"][0] < middle < entry["box"]["high"][0]
    splats = {"lift": lift["id"], "sets": "object:1"}
    ply = client.get("/query/splats", params=splats).content
    assert f"element vertex {SPLATS_A_CLUSTER}\n".encode() in ply[:200]
    assert_problem(client.get("/query/splats", params=splats | {"sets": "object:77"}))
    assert_problem(client.get(lift["links"]["objects"], params={"encoder": "nowhere"}), 422)


def test_object_takes_a_name_and_is_hidden(client: httpx.Client, lift: dict[str, Any]) -> None:
    path = lift["links"]["objects"]
    before = client.get(path).json()["objects"]
    assert client.patch(f"{path}/0", json={"name": "the mug", "hidden": True}).status_code == 200
    first = client.get(path).json()["objects"][0]
    assert (first["name"], first["hidden"]) == ("the mug", True)
    assert client.patch(f"{path}/0", json={"name": None, "hidden": False}).status_code == 200
    assert client.get(path).json()["objects"] == before
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


def test_region_under_a_pixel_is_an_example_to_ask_by(client: httpx.Client, lift: dict[str, Any]) -> None:
    at = {"view": "middle", "x": 26, "y": 12}
    (region,) = client.get(f"/lifts/{lift['id']}/regions", params=at).json()["regions"]
    assert region["example"] == "region:middle:0:2"
    answer = client.get("/query", params={"lift": lift["id"], "like": region["example"], "threshold": 0.5}).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {WORDS.index("lamp")}
    mask = client.get(f"/lifts/{lift['id']}/regions/mask", params={"view": "middle", "level": 0, "region": 2})
    assert picture(mask.content)[12, 26] == 255 and picture(mask.content)[12, 2] == 0
    assert_problem(client.get(f"/lifts/{lift['id']}/regions", params=at | {"x": WIDTH}), 422)


def test_deleted_lift_is_gone_with_all_that_is_of_it(
    client: httpx.Client, lift: dict[str, Any], order: dict[str, Any]
) -> None:
    other = lift_of(client, order)
    newest, *earlier = [entry["id"] for entry in client.get("/lifts").json()["lifts"]]
    assert newest == other["id"] and lift["id"] in earlier
    selection = client.post(f"/lifts/{other['id']}/selections", json={"name": "mine"}).json()["links"]["self"]
    delete_lift(client, other["id"])
    for name, link in other["links"].items():
        assert_problem(client.get(link + "apple" * (name == "query")), 404)
    assert_problem(client.get(selection), 404)
    assert_problem(client.delete(f"/lifts/{other['id']}"), 404)
    assert client.get(lift["links"]["features"]).status_code == 200
