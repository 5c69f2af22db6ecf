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
    HEIGHT,
    WIDTH,
    TinyScene,
    cameras_document,
    colmap_zip,
)

from .conftest import serving
from .test_problems import assert_problem


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
