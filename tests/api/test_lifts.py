"""Lifts that people name, bring from elsewhere and look at: photos, splats, colours, views, objects and regions."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image, ImageOps
from safetensors import safe_open
from safetensors.numpy import load, save

from liftcore.cli import main
from liftcore.files import PhotoIndexes
from liftcore.io.splat import ROW
from liftcore.lifting.files import lift_files
from liftcore.query.scene import Scene
from liftcore.values.settings import LiftSettings
from service.store.database import DATABASE

from .conftest import serving
from .test_problems import NO_ASSET, assert_problem
from .tiny_scene import (
    FOCAL,
    HEIGHT,
    SPLATS_A_CLUSTER,
    VIEWS,
    WIDTH,
    WORDS,
    TinyScene,
    cameras_document,
    colmap_zip,
    splat_rows,
)


def photos(**named: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, photo in named.items():
            archive.writestr(f"images/{name}.png", photo)
        archive.writestr("__MACOSX/images/._left.png", b"beside")
    return content.getvalue()


def png() -> bytes:
    content = io.BytesIO()
    Image.new("RGB", (32, 24), (9, 99, 199)).save(content, "PNG")
    return content.getvalue()


def test_lift_has_the_name_that_somebody_gave_it(client: TestClient, lift: dict[str, Any]) -> None:
    at = f"/lifts/{lift['id']}"
    assert lift["name"] is None
    assert client.patch(at, json={"name": "Kitchen \u2013 Tuesday"}).json()["name"] == "Kitchen \u2013 Tuesday"
    assert [one["name"] for one in client.get("/lifts").json()["lifts"]] == ["Kitchen \u2013 Tuesday"]
    for wrong in ("x" * 101, "two\nlines", 3):
        assert assert_problem(client.patch(at, json={"name": wrong})).get("status") == 422
    assert client.patch(at, json={}).json()["name"] == "Kitchen \u2013 Tuesday"  # what is left out stays
    assert client.patch(at, json={"name": " x "}).json()["name"] == "x"
    assert client.patch(at, json={"name": " "}).json()["name"] is None
    assert client.patch(f"/lifts/{'e' * 32}", json={"name": "x"}).status_code == 404


def test_sizes_are_in_metres_once_somebody_says_how_long_a_unit_is(client: TestClient, lift: dict[str, Any]) -> None:
    at, unknown = f"/lifts/{lift['id']}", {"up": None, "metres_per_unit": None}

    def told() -> list[Any]:
        found = [client.get(f"{at}/{what}").json() for what in ("objects", "tree")]
        found.append(client.post("/query/objects", json={"lift": lift["id"], "like": ["splat:1"]}).json())
        assert found[0]["world"] == found[1]["world"] == found[2]["world"] == client.get(at).json()["world"]
        sizes = [one["size"] for part in found for one in part.get("objects", part.get("nodes"))]
        return [found[0]["world"], {part["unit"] for part in found}, np.array(sizes)]

    world, unit, plain = told()
    assert (world, unit) == (unknown, {"scene units"}) and len(plain) > 3
    known = {"between": [[0, 0, 0], [0, 0, 4]], "metres": 1}
    assert client.patch(at, json={"world": {"up": [0, -2, 0], "distance": known}}).status_code == 200
    world, unit, metres = told()
    assert (world, unit) == ({"up": [0, -1, 0], "metres_per_unit": 0.25}, {"metres"})
    np.testing.assert_allclose(metres, plain / 4)
    for wrong in (
        {"up": [0, 0, 0]},
        {"metres_per_unit": 0},
        {"down": [0, 1, 0]},
        {"up": None, "distance": {"metres": 1}},
    ):
        assert assert_problem(client.patch(at, json={"world": wrong})).get("status") == 422
    assert client.patch(at, json={"name": "x"}).json()["world"]["metres_per_unit"] == 0.25
    assert client.patch(at, json={"world": None, "name": " "}).json()["world"] == unknown
    assert told()[:2] == [unknown, {"scene units"}]
    assert len(client.get(lift["links"]["features"]).content) == lift["bytes"]  # the file as it was made


def test_photos_are_shown_as_they_were_uploaded(client: TestClient, lift: dict[str, Any]) -> None:
    at = f"/lifts/{lift['id']}"
    asset = client.put("/assets/photos", content=photos(left=png())).json()
    assert asset["counts"] == {"photos": 1, "names": ["left"]} and "1 entries" in asset["warnings"][0]
    assert client.get(f"{at}/photo", params={"view": "left"}).status_code == 404
    assert client.patch(at, json={"photos": asset["id"]}).json()["photos"] == asset["id"]
    photo = client.get(f"{at}/photo", params={"view": "left"})
    assert (photo.content, photo.headers["content-type"]) == (png(), "image/png")
    tagged = {"If-None-Match": photo.headers["etag"]}
    assert client.get(f"{at}/photo", params={"view": "left"}, headers=tagged).status_code == 304
    assert {view["name"]: view["photo"] for view in client.get(f"{at}/views").json()["views"]} == {
        "left": True, "middle": False, "right": False
    }  # fmt: skip
    assert client.delete(f"/assets/{asset['id']}").status_code == 409  # the lift needs it
    assert assert_problem(client.patch(at, json={"photos": lift["splats"]}))["status"] == 404
    assert client.patch(at, json={"photos": None}).json()["photos"] is None
    assert client.delete(f"/assets/{asset['id']}").status_code == 204


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_photo_is_served_in_the_orientation_of_its_camera(
    client: TestClient, lift: dict[str, Any], kind: str
) -> None:
    stored, asked = Image.new("RGB", (WIDTH, HEIGHT)), Image.Exif()
    stored.paste((250, 0, 0), (0, 0, WIDTH // 2, HEIGHT))
    asked[0x0112] = 6  # turn it clockwise
    files = {}
    for view, image in {"left": stored, "middle": stored.transpose(Image.Transpose.ROTATE_90)}.items():
        content = io.BytesIO()
        image.save(content, kind, exif=asked)
        files[view] = content.getvalue()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for view, photo in files.items():
            archive.writestr(f"{view}.{'jpg' if kind == 'JPEG' else 'png'}", photo)
    asset = client.put("/assets/photos", content=content.getvalue()).json()
    at = f"/lifts/{lift['id']}"
    client.patch(at, json={"photos": asset["id"]})
    for view, photo in files.items():
        shown = Image.open(io.BytesIO(client.get(f"{at}/photo", params={"view": view}).content))
        assert shown.size == Image.open(io.BytesIO(photo)).size
        shown.load()
        turned = ImageOps.exif_transpose(shown)
        assert turned.size == (WIDTH, HEIGHT)
        assert np.abs(np.asarray(turned, np.int64) - np.asarray(stored, np.int64)).max() < 60
    assert client.get(f"{at}/photo", params={"view": "middle"}).content == files["middle"]


def test_directory_of_photos_is_read_once_for_all_that_ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "photos.zip"
    path.write_bytes(b"before the zip" + photos(left=png(), right=png()))
    opened: list[Path] = []
    real = zipfile.ZipFile
    monkeypatch.setattr(zipfile, "ZipFile", lambda of: (opened.append(of), real(of))[1])
    indexes = PhotoIndexes()

    def read(view: str) -> bytes:
        found = indexes.of(path).open(view)
        assert found is not None
        return b"".join(found[2])

    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(read, ["left", "right", "images/left"] * 8)) == {png()}
    assert opened == [path] and indexes.of(path).names(["left", "middle"]) == {"left"}
    assert indexes.of(path).open("middle") is None


def test_lift_file_from_elsewhere_becomes_a_lift(
    client: TestClient, lift: dict[str, Any], scene: TinyScene, start: Callable[..., Any]
) -> None:
    content = client.get(lift["links"]["features"]).content
    with start("elsewhere") as other:
        told = assert_problem(other.post("/lifts", content=content))  # nothing that it was made of is there
        assert told["status"] == 404 and told["got"] == lift["splats"]
        other.put("/assets/splats", content=scene.splats)
        other.put("/assets/cameras", content=scene.cameras)
        made = other.post("/lifts", content=content)
        again = other.post("/lifts", content=content)
        assert (made.status_code, again.status_code) == (201, 200) and again.json()["id"] == made.json()["id"]
        brought = made.json()
        assert brought["features"] == [] and brought["count"] == lift["count"]
        asked = {"lift": brought["id"], "text": "lamp"}
        theirs = client.get("/query", params=asked | {"lift": lift["id"]}).json()
        assert other.get("/query", params=asked).json()["top"] == theirs["top"]
        assert other.get("/render", params={"lift": brought["id"], "view": "left"}).status_code == 200
        region = {"lift": brought["id"], "like": "region:left:0:0"}
        assert "packs" in assert_problem(other.get("/query", params=region))["expected"]
        assert other.delete(f"/jobs/{brought['id']}?with_lift=true").status_code == 204
        assert other.get("/lifts").json()["lifts"] == []


def test_lift_of_a_folder_of_cameras_takes_a_zip_of_them(
    scene: TinyScene, table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cameras.zip").write_bytes(colmap_zip())
    zipfile.ZipFile(tmp_path / "cameras.zip").extractall(tmp_path / "scene")
    for name, content in (("s.ply", scene.splats), ("f.safetensors", scene.features)):
        (tmp_path / name).write_bytes(content)
    files = tmp_path / "s.ply", tmp_path / "scene", [tmp_path / "f.safetensors"]
    lift_files(*files, LiftSettings.of(preset="row-sum")).save(tmp_path / "lift.safetensors")
    lift = (tmp_path / "lift.safetensors").read_bytes()
    data = tmp_path / "data"
    with serving(data, table) as client:
        client.put("/assets/splats", content=scene.splats)
        told = assert_problem(client.post("/lifts", content=lift))
        assert told["status"] == 404 and "a zip of it" in told["hint"]
        moved = json.dumps({**cameras_document(), "fl_x": 31.0}).encode()
        others, same = (client.put("/assets/cameras", content=body).json()["id"] for body in (moved, colmap_zip()))
        told = assert_problem(client.post("/lifts", params={"cameras": others}, content=lift))
        assert (told["type"], told["argument"]) == ("/problems/invalid-lift", "cameras")
        made = client.post("/lifts", params={"cameras": same}, content=lift)
        assert made.status_code == 201 and made.json()["cameras"] == same
        assert client.get("/query/mask", params={"text": "lamp", "view": "left"}).status_code == 200
    (data / DATABASE).unlink()
    assert main(["store", "rebuild", "--data", str(data), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lifts"] == 1
    with serving(data, table) as client:
        assert client.get("/lifts").json()["lifts"][0]["cameras"] == same


def test_broken_lift_files_are_refused(client: TestClient, lift: dict[str, Any], tmp_path: Any) -> None:
    content = client.get(lift["links"]["features"]).content
    tensors = load(content)
    (tmp_path / "lift").write_bytes(content)
    with safe_open(tmp_path / "lift", framework="np") as opened:
        metadata = opened.metadata()

    def refused(**changed: np.ndarray) -> str:
        reply = client.post("/lifts", content=save({**tensors, **changed}, metadata))
        return assert_problem(reply)["type"]

    endless = tensors["features"].copy()
    endless[-1, -1] = np.inf
    fewer = {name: values[:-1] for name, values in tensors.items()}
    empty = {"object": np.full(lift["count"], -1, np.int32), "object_views": np.zeros((1, 5), np.int32)}
    short = {"total_weight": tensors["total_weight"][1:]}
    for type_ in (refused(features=endless), refused(**short), refused(**fewer), refused(**empty)):
        assert type_ == "/problems/invalid-lift"
    more = '"diagnostics":{"x":"' + "y" * 70_000 + '",'
    long = {"splatlift": metadata["splatlift"].replace('"diagnostics":{', more)}
    assert "metadata" in assert_problem(client.post("/lifts", content=save(tensors, long)))["expected"]
    endless_time = {"splatlift": metadata["splatlift"].replace('"timings":{', '"timings":{"x":1e999,')}
    assert "timings" in assert_problem(client.post("/lifts", content=save(tensors, endless_time)))["expected"]
    assert client.get("/lifts").status_code == 200
    assert assert_problem(client.post("/lifts", content=b"\x80\x04pickle"))["type"] == "/problems/invalid-lift"


# What a viewer draws of a lift


def test_splats_come_in_the_rows_of_the_lift(client: TestClient, lift: dict[str, Any]) -> None:
    reply = client.get(f"/lifts/{lift['id']}/splats")
    rows, lifted = np.frombuffer(reply.content, ROW), splat_rows()
    assert reply.status_code == 200 and len(rows) == lift["count"] == len(lifted)
    assert int(reply.headers["content-length"]) == 32 * len(lifted)
    np.testing.assert_array_equal(rows["means"], lifted[:, :3])
    np.testing.assert_allclose(rows["scales"], np.exp(lifted[:, 7:10]), rtol=1e-6)
    np.testing.assert_allclose(
        rows["colours"][:, :3] / 255, np.clip(0.5 + 0.282095 * lifted[:, 3:6], 0, 1), atol=3e-3
    )
    np.testing.assert_allclose(rows["colours"][:, 3] / 255, 1 / (1 + np.exp(-lifted[:, 6])), atol=3e-3)
    assert (rows["quats"] == (255, 128, 128, 128)).all()
    again = client.get(f"/lifts/{lift['id']}/splats", headers={"If-None-Match": reply.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_each_splat_has_a_colour_in_each_layer(client: TestClient, lift: dict[str, Any]) -> None:
    path, shown = f"/lifts/{lift['id']}/colours", {}
    for what in ("pca", "evidence", "agreement"):
        reply = client.get(path, params={"what": what})
        shown[what] = np.load(io.BytesIO(reply.content), allow_pickle=False)
        assert (shown[what].shape, shown[what].dtype) == ((lift["count"], 3), np.uint8) and reply.headers["etag"]
    means = shown["pca"].reshape(3, SPLATS_A_CLUSTER, 3).mean(axis=1)  # of three words, that lie apart
    assert min(np.abs(means[one] - means[other]).max() for one, other in ((0, 1), (0, 2), (1, 2))) > 60
    problem = assert_problem(client.get(path, params={"what": "cluster"}))  # which this lift has none of
    assert (problem["status"], problem["argument"]) == (422, "what") and "aggregation" in problem["hint"]


def test_views_have_their_poses_in_pages(client: TestClient, lift: dict[str, Any]) -> None:
    whole = client.get(f"/lifts/{lift['id']}/views").json()
    assert whole["next"] is None and [view["name"] for view in whole["views"]] == list(VIEWS)
    first = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2}).json()
    rest = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2, "cursor": first["next"]}).json()
    assert first["views"] + rest["views"] == whole["views"] and rest["next"] is None
    for view in whole["views"]:
        assert view["lifted"] == (view["name"] in lift["views"])
        assert (view["width"], view["height"], view["fx"]) == (WIDTH, HEIGHT, FOCAL)
        pose = np.array(view["viewmat"])
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], (VIEWS[view["name"]], 0, 0), atol=1e-6)


def test_relations_of_objects_have_their_numbers_and_come_once(
    client: TestClient, lift: dict[str, Any], scene: TinyScene, tmp_path: Path
) -> None:
    (tmp_path / "lift").write_bytes(client.get(lift["links"]["features"]).content)
    tensors = load((tmp_path / "lift").read_bytes())
    cluster = np.arange(SPLATS_A_CLUSTER)
    tensors["object"][:] = tensors["node"][:] = 2
    tensors["object"][cluster] = tensors["node"][cluster] = splat_rows()[cluster, 0] > -1.2  # its halves
    with safe_open(tmp_path / "lift", framework="np") as opened:
        links = client.post("/lifts", content=save(tensors, opened.metadata())).json()["links"]
    route = links["tree"]
    plain = client.get(route).json()
    assert (plain["relations"], plain["world"]["up"]) == ([], None)
    unknown = client.get(route, params={"relations": True}).json()
    assert unknown["nodes"] == plain["nodes"] and unknown["world"]["up"] is None
    assert {one["relation"] for one in unknown["relations"]} <= {"touching", "inside"}
    whole = client.get(route, params={"relations": True, "up": "0,-1,0"}).json()
    (beside,) = [one for one in whole["relations"] if one["relation"] == "beside"]
    assert {beside["node"], beside["other"]} == {0, 1} and 0 <= beside["gap"] < 0.2 and beside["overlap"] > 0.5
    pages = [client.get(route, params={"up": "0,-2,0", "limit": 1, "cursor": at}).json() for at in range(3)]
    assert [one for page in pages for one in page["relations"]] == whole["relations"]
    cameras = client.get(route, params={"up": "cameras"}).json()
    np.testing.assert_allclose(cameras["world"]["up"], (0, 1, 0), atol=1e-6)
    assert cameras["relations"] == whole["relations"]
    for wrong in ("0,-1", "0,-1,0,0", "nan,0,1", "0,0,0", "1e999,0,0", "up", ""):
        problem = assert_problem(client.get(route, params={"up": wrong}))
        assert (problem["status"], problem["argument"]) == (422, "up")
    assert client.delete(links["self"]).status_code == 204


def test_objects_are_there_without_words_and_a_table_names_them(
    client: TestClient, lift: dict[str, Any], scene: TinyScene
) -> None:
    route = lift["links"]["objects"]
    whole = client.get(route).json()
    assert (whole["count"], whole["next"], whole["encoder"]) == (3, None, None)
    assert [one["id"] for one in whole["objects"]] == [0, 1, 2]
    assert all(one["name"] is None and set(one["views"]) <= set(VIEWS) for one in whole["objects"])
    assert sum(one["splats"] for one in whole["objects"]) == lift["count"]
    pages = [client.get(route, params={"limit": 2, "cursor": first}).json() for first in (0, 2)]
    assert pages[0]["objects"] + pages[1]["objects"] == whole["objects"]
    assert (pages[0]["next"], pages[1]["next"]) == (2, None)
    tree = client.get(lift["links"]["tree"], params={"limit": 2}).json()
    assert (tree["count"], tree["next"], tree["lift"]) == (3, 2, lift["id"])
    for node, thing in zip(tree["nodes"], whole["objects"], strict=False):
        del thing["hidden"]  # which is said of listed things alone
        assert node.items() >= thing.items() and (node["kind"], node["path"]) == ("object", [node["id"]])
    table = client.put("/assets/table", content=scene.table).json()["id"]
    for how in ({"table": table}, {"encoder": "default"}, {"encoder": lift["text_space"]}):
        named = client.get(route, params={**how, "features": True}).json()["objects"]
        for one in named:
            middle = one["centre"][0]
            assert one["name"] == WORDS[round(middle / 1.2) + 1] and one["score"] > 0.9
            assert one["box"]["low"][0] < middle < one["box"]["high"][0] and len(one["feature"]) == lift["channels"]
    ply = client.get(f"{route}/1/splats")
    rows = np.frombuffer(ply.content[ply.content.index(b"end_header\n") + 11 :], "<f4").reshape(-1, 14)
    assert len(rows) == whole["objects"][1]["splats"]
    assert np.abs(rows[:, 0] - whole["objects"][1]["centre"][0]).max() < 0.5
    for path, how, status in (
        (route, {"table": NO_ASSET}, 404),
        (route, {"table": NO_ASSET, "encoder": "default"}, 422),
        (route, {"encoder": "nowhere"}, 422),
        (route, {"limit": 0}, 422),
        (f"{route}/3/splats", {}, 404),
        (f"{route}/-1/splats", {}, 422),
    ):
        assert assert_problem(client.get(path, params=how))["status"] == status


def test_other_kernels_are_shown_as_near_gaussians() -> None:
    from liftcore.query.export import splats_as
    from liftcore.scene.splats import Splats

    means, quats, logits = np.zeros((2, 3), "f4"), np.zeros((2, 4), "f4"), np.array([np.inf, -np.inf], "f4")
    discs = Splats(means, quats, np.log(np.full((2, 2), 0.5, "f4")), logits, "2dgs")
    betas = Splats(means, quats, np.zeros((2, 3), "f4"), logits, "dbs", beta=np.zeros(2, "f4"))
    shown = []
    for splats in (discs, betas):
        scene = Scene.__new__(Scene)
        scene.__dict__ |= {"splats": splats, "world": splats.world}
        shown.append(np.frombuffer(b"".join(splats_as(scene, ".splat")), ROW))
    np.testing.assert_allclose(shown[0]["scales"], [[0.5, 0.5, 0.005]] * 2, rtol=1e-5)
    np.testing.assert_allclose(shown[1]["scales"], np.sqrt(1 / 12), rtol=1e-5)  # (1 - r^2)^4 in the image
    assert shown[0]["colours"].tolist() == [[153, 153, 153, 255], [153, 153, 153, 0]]  # no colours: grey
    assert (shown[0]["quats"][:, 0] == 255).all()  # of no length: no turn


def test_regions_at_a_pixel_are_examples_to_ask_by(client: TestClient, lift: dict[str, Any]) -> None:
    at, lamp = f"/lifts/{lift['id']}/regions", {"view": "middle", "x": 26, "y": 12}
    (region,) = client.get(at, params=lamp).json()["regions"]
    assert (region["example"], region["level"], region["region"]) == ("region:middle:0:2", 0, WORDS.index("lamp"))
    answer = client.get("/query", params={"lift": lift["id"], "like": region["example"], "threshold": 0.5}).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {WORDS.index("lamp")}
    where = {name: region[name] for name in ("view", "level", "region")}
    mask = client.get(f"{at}/mask", params=where)
    pixels = np.asarray(Image.open(io.BytesIO(mask.content)))
    assert pixels.shape == (HEIGHT, WIDTH) and pixels[12, 26] == 255 and pixels.mean() == 255 * region["share"]
    for path, asked, status in ((at, lamp | {"x": WIDTH}, 422), (at, lamp | {"view": "nowhere"}, 404),
                                (f"{at}/mask", where | {"region": 3}, 404)):  # fmt: skip
        assert assert_problem(client.get(path, params=asked))["status"] == status
