"""Lifts that people name, bring from elsewhere and look at beside photos; and a plan before the order."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import load, save

from liftcore.io.scene_files import lift_files
from liftcore.settings import LiftSettings
from service.store.__main__ import main
from service.store.database import DATABASE

from .conftest import Uploaded, serving
from .test_problems import assert_problem
from .tiny_scene import TinyScene, cameras_document, colmap_zip


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


def lift_file(client: TestClient, lift: dict[str, Any], tmp_path: Any) -> tuple[bytes, dict[str, str]]:
    content = client.get(f"/lifts/{lift['id']}/features").content
    (tmp_path / "lift.safetensors").write_bytes(content)
    with safe_open(tmp_path / "lift.safetensors", framework="np") as opened:
        return content, opened.metadata()


def test_lift_has_the_name_that_somebody_gave_it(client: TestClient, lift: dict[str, Any]) -> None:
    at = f"/lifts/{lift['id']}"
    assert lift["name"] is None
    assert client.patch(at, json={"name": "Kitchen \u2013 Tuesday"}).json()["name"] == "Kitchen \u2013 Tuesday"
    assert [one["name"] for one in client.get("/lifts").json()["lifts"]] == ["Kitchen \u2013 Tuesday"]
    for wrong in ("x" * 101, "two\nlines", 3):
        assert assert_problem(client.patch(at, json={"name": wrong})).get("status") == 422
    assert client.patch(at, json={}).json()["name"] == "Kitchen \u2013 Tuesday"  # what is left out stays
    assert client.patch(at, json={"name": ""}).json()["name"] is None
    assert client.patch(f"/lifts/{'e' * 32}", json={"name": "x"}).status_code == 404


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


def test_lift_file_from_elsewhere_becomes_a_lift(
    client: TestClient, lift: dict[str, Any], scene: TinyScene, start: Callable[..., Any], tmp_path: Any
) -> None:
    content, _ = lift_file(client, lift, tmp_path)
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
    assert main(["rebuild", "--data", str(data), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lifts"] == 1
    with serving(data, table) as client:
        assert client.get("/lifts").json()["lifts"][0]["cameras"] == same


def test_broken_lift_files_are_refused(client: TestClient, lift: dict[str, Any], tmp_path: Any) -> None:
    content, metadata = lift_file(client, lift, tmp_path)
    tensors = load(content)

    def refused(**changed: np.ndarray) -> str:
        reply = client.post("/lifts", content=save({**tensors, **changed}, metadata))
        return assert_problem(reply)["type"]

    endless = tensors["features"].copy()
    endless[-1, -1] = np.inf
    fewer = {name: values[:-1] for name, values in tensors.items()}
    for type_ in (refused(features=endless), refused(evidence=tensors["evidence"][1:]), refused(**fewer)):
        assert type_ == "/problems/invalid-lift"
    more = '"certificate":{"x":"' + "y" * 70_000 + '",'
    long = {"splatlift": metadata["splatlift"].replace('"certificate":{', more)}
    assert "metadata" in assert_problem(client.post("/lifts", content=save(tensors, long)))["expected"]
    endless_time = {"splatlift": metadata["splatlift"].replace('"timings":{', '"timings":{"x":1e999,')}
    assert "timings" in assert_problem(client.post("/lifts", content=save(tensors, endless_time)))["expected"]
    assert client.get("/lifts").status_code == 200
    assert assert_problem(client.post("/lifts", content=b"\x80\x04pickle"))["type"] == "/problems/invalid-lift"


def test_plan_is_told_before_the_order(client: TestClient, uploaded: Uploaded) -> None:
    jobs = len(client.get("/jobs").json()["jobs"])
    plan = client.post("/lift/plan", json=uploaded.order(preset="row-sum"))
    assert plan.status_code == 200 and "60 splats" in plan.json()["summary"][0]
    assert len(client.get("/jobs").json()["jobs"]) == jobs
    assert client.post("/lift/plan", json=uploaded.order(preset="none")).status_code == 422
