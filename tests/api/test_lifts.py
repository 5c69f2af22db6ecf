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
from tests.tiny_scene import (
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

from .conftest import serving
from .test_problems import NO_ASSET, assert_problem


def photos(**names: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, photo in names.items():
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
    assert [entry["name"] for entry in client.get("/lifts").json()["lifts"]] == ["Kitchen \u2013 Tuesday"]
    for wrong in ("x" * 101, "two\nlines", 3):
        assert assert_problem(client.patch(at, json={"name": wrong})).get("status") == 422
    assert client.patch(at, json={}).json()["name"] == "Kitchen \u2013 Tuesday"  # what is left out stays
    assert client.patch(at, json={"name": " x "}).json()["name"] == "x"
    assert client.patch(at, json={"name": " "}).json()["name"] is None
    assert client.patch(f"/lifts/{'e' * 32}", json={"name": "x"}).status_code == 404


def test_sizes_are_in_metres_once_somebody_says_how_long_a_unit_is(client: TestClient, lift: dict[str, Any]) -> None:
    at, unknown = f"/lifts/{lift['id']}", {"up": None, "metres_per_unit": None}

    def read_sizes() -> list[Any]:
        documents = [client.get(f"{at}/{kind}").json() for kind in ("objects", "tree")]
        documents.append(client.post("/query/objects", json={"lift": lift["id"], "like": ["splat:1"]}).json())
        assert (
            documents[0]["world"] == documents[1]["world"] == documents[2]["world"] == client.get(at).json()["world"]
        )
        sizes = [entry["size"] for part in documents for entry in part.get("objects", part.get("nodes"))]
        return [documents[0]["world"], {part["unit"] for part in documents}, np.array(sizes)]

    world, unit, unscaled = read_sizes()
    assert (world, unit) == (unknown, {"scene units"}) and len(unscaled) > 3
    distance = {"between": [[0, 0, 0], [0, 0, 4]], "metres": 1}
    assert client.patch(at, json={"world": {"up": [0, -2, 0], "distance": distance}}).status_code == 200
    world, unit, metres = read_sizes()
    assert (world, unit) == ({"up": [0, -1, 0], "metres_per_unit": 0.25}, {"metres"})
    np.testing.assert_allclose(metres, unscaled / 4)
    for wrong in (
        {"up": [0, 0, 0]},
        {"metres_per_unit": 0},
        {"down": [0, 1, 0]},
        {"up": None, "distance": {"metres": 1}},
    ):
        assert assert_problem(client.patch(at, json={"world": wrong})).get("status") == 422
    assert client.patch(at, json={"name": "x"}).json()["world"]["metres_per_unit"] == 0.25
    assert client.patch(at, json={"world": None, "name": " "}).json()["world"] == unknown
    assert read_sizes()[:2] == [unknown, {"scene units"}]
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
    stored, parameters = Image.new("RGB", (WIDTH, HEIGHT)), Image.Exif()
    stored.paste((250, 0, 0), (0, 0, WIDTH // 2, HEIGHT))
    parameters[0x0112] = 6  # turn it clockwise
    files = {}
    for view, image in {"left": stored, "middle": stored.transpose(Image.Transpose.ROTATE_90)}.items():
        content = io.BytesIO()
        image.save(content, kind, exif=parameters)
        files[view] = content.getvalue()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for view, photo in files.items():
            archive.writestr(f"{view}.{'jpg' if kind == 'JPEG' else 'png'}", photo)
    asset = client.put("/assets/photos", content=content.getvalue()).json()
    at = f"/lifts/{lift['id']}"
    client.patch(at, json={"photos": asset["id"]})
    for view, photo in files.items():
        opacities = Image.open(io.BytesIO(client.get(f"{at}/photo", params={"view": view}).content))
        assert opacities.size == Image.open(io.BytesIO(photo)).size
        opacities.load()
        upright = ImageOps.exif_transpose(opacities)
        assert upright.size == (WIDTH, HEIGHT)
        assert np.abs(np.asarray(upright, np.int64) - np.asarray(stored, np.int64)).max() < 60
    assert client.get(f"{at}/photo", params={"view": "middle"}).content == files["middle"]


def test_directory_of_photos_is_read_once_for_all_that_ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "photos.zip"
    path.write_bytes(b"before the zip" + photos(left=png(), right=png()))
    file: list[Path] = []
    real = zipfile.ZipFile
    monkeypatch.setattr(zipfile, "ZipFile", lambda of: (file.append(of), real(of))[1])
    indexes = PhotoIndexes()

    def read(view: str) -> bytes:
        photo = indexes.of(path).open(view)
        assert photo is not None
        return b"".join(photo[2])

    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(read, ["left", "right", "images/left"] * 8)) == {png()}
    assert file == [path] and indexes.of(path).names(["left", "middle"]) == {"left"}
    assert indexes.of(path).open("middle") is None


def test_lift_file_from_elsewhere_becomes_a_lift(
    client: TestClient, lift: dict[str, Any], scene: TinyScene, start: Callable[..., Any]
) -> None:
    content = client.get(lift["links"]["features"]).content
    with start("elsewhere") as other:
        problem = assert_problem(other.post("/lifts", content=content))  # nothing that it was made of is there
        assert problem["status"] == 404 and problem["got"] == lift["splats"]
        other.put("/assets/splats", content=scene.splats)
        other.put("/assets/cameras", content=scene.cameras)
        created = other.post("/lifts", content=content)
        second = other.post("/lifts", content=content)
        assert (created.status_code, second.status_code) == (201, 200) and second.json()["id"] == created.json()["id"]
        new_lift = created.json()
        assert new_lift["features"] == [] and new_lift["count"] == lift["count"]
        parameters = {"lift": new_lift["id"], "text": "lamp"}
        original = client.get("/query", params=parameters | {"lift": lift["id"]}).json()
        assert other.get("/query", params=parameters).json()["top"] == original["top"]
        assert other.get("/render", params={"lift": new_lift["id"], "view": "left"}).status_code == 200
        region = {"lift": new_lift["id"], "like": "region:left:0:0"}
        assert "packs" in assert_problem(other.get("/query", params=region))["expected"]
        assert other.delete(f"/jobs/{new_lift['id']}?with_lift=true").status_code == 204
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
        problem = assert_problem(client.post("/lifts", content=lift))
        assert problem["status"] == 404 and "a zip of it" in problem["hint"]
        other_cameras = json.dumps({**cameras_document(), "fl_x": 31.0}).encode()
        other_zip, same_zip = (
            client.put("/assets/cameras", content=body).json()["id"] for body in (other_cameras, colmap_zip())
        )
        problem = assert_problem(client.post("/lifts", params={"cameras": other_zip}, content=lift))
        assert (problem["type"], problem["argument"]) == ("/problems/invalid-lift", "cameras")
        created = client.post("/lifts", params={"cameras": same_zip}, content=lift)
        assert created.status_code == 201 and created.json()["cameras"] == same_zip
        assert client.get("/query/mask", params={"text": "lamp", "view": "left"}).status_code == 200
    (data / DATABASE).unlink()
    assert main(["store", "rebuild", "--data", str(data), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lifts"] == 1
    with serving(data, table) as client:
        assert client.get("/lifts").json()["lifts"][0]["cameras"] == same_zip


def test_broken_lift_files_are_refused(client: TestClient, lift: dict[str, Any], tmp_path: Any) -> None:
    content = client.get(lift["links"]["features"]).content
    tensors = load(content)
    (tmp_path / "lift").write_bytes(content)
    with safe_open(tmp_path / "lift", framework="np") as file:
        metadata = file.metadata()

    def assert_refused(**changes: np.ndarray) -> str:
        reply = client.post("/lifts", content=save({**tensors, **changes}, metadata))
        return assert_problem(reply)["type"]

    endless = tensors["features"].copy()
    endless[-1, -1] = np.inf
    shorter = {name: values[:-1] for name, values in tensors.items()}
    empty = {"object": np.full(lift["count"], -1, np.int32), "object_views": np.zeros((1, 5), np.int32)}
    short = {"total_weight": tensors["total_weight"][1:]}
    for type_ in (
        assert_refused(features=endless),
        assert_refused(**short),
        assert_refused(**shorter),
        assert_refused(**empty),
    ):
        assert type_ == "/problems/invalid-lift"
    long_entry = '"diagnostics":{"x":"' + "y" * 70_000 + '",'
    long = {"splatlift": metadata["splatlift"].replace('"diagnostics":{', long_entry)}
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
    second = client.get(f"/lifts/{lift['id']}/splats", headers={"If-None-Match": reply.headers["etag"]})
    assert (second.status_code, second.content) == (304, b"")


def test_each_splat_has_a_colour_in_each_layer(client: TestClient, lift: dict[str, Any]) -> None:
    path, opacities = f"/lifts/{lift['id']}/colours", {}
    for layer in ("pca", "evidence", "agreement", "total_weight", "view_consistency"):
        reply = client.get(path, params={"what": layer})
        opacities[layer] = np.load(io.BytesIO(reply.content), allow_pickle=False)
        assert (opacities[layer].shape, opacities[layer].dtype) == ((lift["count"], 3), np.uint8) and reply.headers[
            "etag"
        ]
    for old, new in (("evidence", "total_weight"), ("agreement", "view_consistency")):
        assert np.array_equal(opacities[old], opacities[new])
    means = opacities["pca"].reshape(3, SPLATS_A_CLUSTER, 3).mean(axis=1)  # of three words, that lie apart
    assert min(np.abs(means[entry] - means[other]).max() for entry, other in ((0, 1), (0, 2), (1, 2))) > 60
    problem = assert_problem(client.get(path, params={"what": "cluster"}))  # which this lift has none of
    assert (problem["status"], problem["argument"]) == (422, "what") and "aggregation" in problem["hint"]


def test_views_have_their_poses_in_pages(client: TestClient, lift: dict[str, Any]) -> None:
    full = client.get(f"/lifts/{lift['id']}/views").json()
    assert full["next"] is None and [view["name"] for view in full["views"]] == list(VIEWS)
    first = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2}).json()
    rest = client.get(f"/lifts/{lift['id']}/views", params={"limit": 2, "cursor": first["next"]}).json()
    assert first["views"] + rest["views"] == full["views"] and rest["next"] is None
    for view in full["views"]:
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
    with safe_open(tmp_path / "lift", framework="np") as file:
        links = client.post("/lifts", content=save(tensors, file.metadata())).json()["links"]
    route = links["tree"]
    without_relations = client.get(route).json()
    assert (without_relations["relations"], without_relations["world"]["up"]) == ([], None)
    unknown = client.get(route, params={"relations": True}).json()
    assert unknown["nodes"] == without_relations["nodes"] and unknown["world"]["up"] is None
    assert {entry["relation"] for entry in unknown["relations"]} <= {"touching", "inside"}
    full = client.get(route, params={"relations": True, "up": "0,-1,0"}).json()
    (relation,) = [entry for entry in full["relations"] if entry["relation"] == "beside"]
    assert (
        {relation["node"], relation["other"]} == {0, 1} and 0 <= relation["gap"] < 0.2 and relation["overlap"] > 0.5
    )
    pages = [client.get(route, params={"up": "0,-2,0", "limit": 1, "cursor": at}).json() for at in range(3)]
    assert [entry for page in pages for entry in page["relations"]] == full["relations"]
    cameras = client.get(route, params={"up": "cameras"}).json()
    np.testing.assert_allclose(cameras["world"]["up"], (0, 1, 0), atol=1e-6)
    assert cameras["relations"] == full["relations"]
    for wrong in ("0,-1", "0,-1,0,0", "nan,0,1", "0,0,0", "1e999,0,0", "up", ""):
        problem = assert_problem(client.get(route, params={"up": wrong}))
        assert (problem["status"], problem["argument"]) == (422, "up")
    assert client.delete(links["self"]).status_code == 204


def test_objects_are_there_without_words_and_a_table_names_them(
    client: TestClient, lift: dict[str, Any], scene: TinyScene
) -> None:
    route = lift["links"]["objects"]
    full = client.get(route).json()
    assert (full["count"], full["next"], full["encoder"]) == (3, None, None)
    assert [entry["id"] for entry in full["objects"]] == [0, 1, 2]
    assert all(entry["name"] is None and set(entry["views"]) <= set(VIEWS) for entry in full["objects"])
    assert sum(entry["splats"] for entry in full["objects"]) == lift["count"]
    pages = [client.get(route, params={"limit": 2, "cursor": first}).json() for first in (0, 2)]
    assert pages[0]["objects"] + pages[1]["objects"] == full["objects"]
    assert (pages[0]["next"], pages[1]["next"]) == (2, None)
    tree = client.get(lift["links"]["tree"], params={"limit": 2}).json()
    assert (tree["count"], tree["next"], tree["lift"]) == (3, 2, lift["id"])
    for node, entry in zip(tree["nodes"], full["objects"], strict=False):
        del entry["hidden"]  # which is said of listed things alone
        assert node.items() >= entry.items() and (node["kind"], node["path"]) == ("object", [node["id"]])
    table = client.put("/assets/table", content=scene.table).json()["id"]
    for options in ({"table": table}, {"encoder": "default"}, {"encoder": lift["text_space"]}):
        names = client.get(route, params={**options, "features": True}).json()["objects"]
        for entry in names:
            middle = entry["centre"][0]
            assert entry["name"] == WORDS[round(middle / 1.2) + 1] and entry["score"] > 0.9
            assert (
                entry["box"]["low"][0] < middle < entry["box"]["high"][0]
                and len(entry["feature"]) == lift["channels"]
            )
    ply = client.get(f"{route}/1/splats")
    rows = np.frombuffer(ply.content[ply.content.index(b"end_header\n") + 11 :], "<f4").reshape(-1, 14)
    assert len(rows) == full["objects"][1]["splats"]
    assert np.abs(rows[:, 0] - full["objects"][1]["centre"][0]).max() < 0.5
    for path, options, status in (
        (route, {"table": NO_ASSET}, 404),
        (route, {"table": NO_ASSET, "encoder": "default"}, 422),
        (route, {"encoder": "nowhere"}, 422),
        (route, {"limit": 0}, 422),
        (f"{route}/3/splats", {}, 404),
        (f"{route}/-1/splats", {}, 422),
    ):
        assert assert_problem(client.get(path, params=options))["status"] == status


def test_other_kernels_are_shown_as_near_gaussians() -> None:
    from liftcore.query.export import splats_as
    from liftcore.scene.splats import Splats

    means, quats, logits = np.zeros((2, 3), "f4"), np.zeros((2, 4), "f4"), np.array([np.inf, -np.inf], "f4")
    discs = Splats(means, quats, np.log(np.full((2, 2), 0.5, "f4")), logits, "2dgs")
    betas = Splats(means, quats, np.zeros((2, 3), "f4"), logits, "dbs", beta=np.zeros(2, "f4"))
    opacities = []
    for splats in (discs, betas):
        scene = Scene.__new__(Scene)
        scene.__dict__ |= {"splats": splats, "world": splats.world}
        opacities.append(np.frombuffer(b"".join(splats_as(scene, ".splat")), ROW))
    np.testing.assert_allclose(opacities[0]["scales"], [[0.5, 0.5, 0.005]] * 2, rtol=1e-5)
    np.testing.assert_allclose(opacities[1]["scales"], np.sqrt(1 / 12), rtol=1e-5)  # (1 - r^2)^4 in the image
    assert opacities[0]["colours"].tolist() == [[153, 153, 153, 255], [153, 153, 153, 0]]  # no colours: grey
    assert (opacities[0]["quats"][:, 0] == 255).all()  # of no length: no turn


def test_regions_at_a_pixel_are_examples_to_ask_by(client: TestClient, lift: dict[str, Any]) -> None:
    at, lamp = f"/lifts/{lift['id']}/regions", {"view": "middle", "x": 26, "y": 12}
    (region,) = client.get(at, params=lamp).json()["regions"]
    assert (region["example"], region["level"], region["region"]) == ("region:middle:0:2", 0, WORDS.index("lamp"))
    answer = client.get("/query", params={"lift": lift["id"], "like": region["example"], "threshold": 0.5}).json()
    assert {splat["splat"] // SPLATS_A_CLUSTER for splat in answer["top"]} == {WORDS.index("lamp")}
    region_fields = {name: region[name] for name in ("view", "level", "region")}
    mask = client.get(f"{at}/mask", params=region_fields)
    pixels = np.asarray(Image.open(io.BytesIO(mask.content)))
    assert pixels.shape == (HEIGHT, WIDTH) and pixels[12, 26] == 255 and pixels.mean() == 255 * region["share"]
    for path, parameters, status in ((at, lamp | {"x": WIDTH}, 422), (at, lamp | {"view": "nowhere"}, 404),
                                (f"{at}/mask", region_fields | {"region": 3}, 404)):  # fmt: skip
        assert assert_problem(client.get(path, params=parameters))["status"] == status
