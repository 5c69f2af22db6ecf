"""Scenes of other kinds over HTTP: discs and betas, files of editors, rigs and panoramas."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient
from plyfile import PlyData

from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.splats import Kernel
from service.models import AssetKind
from tests.server import wait_for_end
from tests.tiny_scene import (
    PROPERTIES,
    SPLATS_A_CLUSTER,
    cameras_document,
    labels,
    pack,
    ply,
    splat_rows,
)

from .conftest import SceneAssets, put
from .test_problems import assert_problem

FILES = Path(__file__).parents[1] / "data" / "splats"


# Kernels and formats


def discs() -> bytes:
    """The tiny scene with two scales a splat; unturned discs face its cameras."""
    properties = [name for name in PROPERTIES if name != "scale_2"]
    return ply(splat_rows()[:, [PROPERTIES.index(name) for name in properties]], properties)


def betas() -> bytes:
    """The tiny scene with colours of DBS, a shape a splat and one lobe."""
    names = [name.replace("f_dc", "sh0") for name in PROPERTIES]
    extra_properties = ["beta", *(f"sb_params_{i}" for i in range(6))]
    columns = np.zeros((len(splat_rows()), len(extra_properties)), np.float32)
    return ply(np.concatenate([splat_rows(), columns], axis=1), [*names, *extra_properties])


def test_discs_are_lifted_and_answered_in_their_rows(client: TestClient, scene_assets: SceneAssets) -> None:
    warm_up(Kernel.GAUSSIAN_2D)  # compiles, where nobody has yet: that may take longer than `ended` waits
    asset = client.put("/assets/splats", content=discs()).json()
    assert asset["counts"]["kernel"] == "2dgs"
    order = replace(scene_assets, splats=asset["id"]).order(preset="row-sum", diagnostic_rays=0)
    job = wait_for_end(client, client.post("/lift", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    parameters = {"lift": job["id"], "text": "apple", "view": "middle", "threshold": 0.5}
    answer = client.get("/query", params=parameters).json()
    scores = np.load(io.BytesIO(client.get(answer["links"]["scores"]).content), allow_pickle=False)
    assert set(np.argsort(-scores)[:SPLATS_A_CLUSTER]) == set(range(SPLATS_A_CLUSTER))
    view_labels = PlyData.read(io.BytesIO(client.get(answer["links"]["object"]).content))
    assert np.array_equal(view_labels["vertex"]["x"], splat_rows()[np.flatnonzero(scores >= 0.5), 0])
    for link in ("mask", "render"):
        assert client.get(answer["links"][link]).headers["content-type"] == "image/png"
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(f"/assets/{asset['id']}").status_code == 204


@pytest.mark.parametrize(
    ("content", "settings", "argument", "message"),
    [
        (discs(), {"kernel": "3dgs"}, "kernel", "'scale_2'"),
        (discs(), {"kernel": "dbs"}, "kernel", "leave it out: the file speaks of 2dgs"),
        (betas(), {"antialiased": True}, "antialiased", "dbs"),
    ],
)
def test_kernel_that_does_not_fit_the_splats_is_refused_with_the_order(
    client: TestClient,
    scene_assets: SceneAssets,
    content: bytes,
    settings: dict[str, Any],
    argument: str,
    message: str,
) -> None:
    asset = put(client, AssetKind.SPLATS, content)
    answer = client.post("/lift", json=replace(scene_assets, splats=asset).order(**settings))
    assert assert_problem(answer)["type"] == "/problems/invalid-settings"
    assert argument in answer.json()["detail"] and message in answer.text
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_a_scene_in_map_coordinates_answers_in_them(client: TestClient, scene_assets: SceneAssets) -> None:
    offset, rows, document = (
        np.array([500_000.25, 5_400_000.5, 300.125]),
        splat_rows().astype("f8"),
        cameras_document(),
    )
    rows[:, :3] += offset
    header = ply(splat_rows()).split(b"end_header")[0].replace(b"float", b"double")
    splats = put(client, AssetKind.SPLATS, header + b"end_header\n" + rows.tobytes())
    for frame in document["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += offset
        frame["transform_matrix"] = pose.tolist()
    cameras = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    order = replace(scene_assets, splats=splats, cameras=cameras).order(preset="row-sum", diagnostic_rays=0)
    job = wait_for_end(client, client.post("/lift", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    answer = client.get("/query", params={"lift": job["id"], "text": "apple", "threshold": 0.5, "top": 3}).json()
    for splat in answer["top"]:
        assert np.abs(np.array(splat["position"]) - rows[splat["splat"], :3]).max() < 1e-5
    (entry, *_) = client.get(answer["links"]["objects"]).json()["objects"]
    for box in (answer["box"], entry["box"]):
        assert (np.array(box["low"]) >= rows[:, :3].min(axis=0) - 1e-5).all()
        assert (np.array(box["high"]) <= rows[:, :3].max(axis=0) + 1e-5).all()
    # A viewer's file is about the origin of the lift, and views are in the file's frame.
    scene = np.frombuffer(client.get(f"/lifts/{job['id']}/splats").content, "<f4").reshape(-1, 8)[:, :3]
    origin = client.get(f"/lifts/{job['id']}").json()["origin"]
    assert np.abs(scene + np.array(origin) - rows[:, :3]).max() < 1e-5
    for view in client.get(f"/lifts/{job['id']}/views").json()["views"]:
        pose = np.array(view["viewmat"])
        assert np.abs(-pose[:3, :3].T @ pose[:3, 3] - offset).max() < 8
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    for asset in (splats, cameras):
        assert client.delete(f"/assets/{asset}").status_code == 204


@pytest.mark.parametrize(
    "name", ["degree3.compressed.ply", "degree3.v4.spz", "degree3.sog", "degree3.streamed.zip", "degree3.glb"]
)
def test_formats_that_hold_no_code_are_assets(client: TestClient, name: str) -> None:
    content = (FILES / name).read_bytes()
    asset = client.put("/assets/splats", content=content).json()
    assert asset["counts"]["splats"] == 40
    stored = client.get(f"/assets/{asset['id']}/content")
    assert stored.content == content
    assert stored.headers["content-disposition"].endswith(f'{Path(name).suffix}"')
    assert client.delete(f"/assets/{asset['id']}").status_code == 204


def test_checkpoints_are_refused_over_http_with_a_way_on(client: TestClient) -> None:
    content = io.BytesIO()
    torch.save({"splats": {"means": torch.zeros(2, 3)}}, content)
    problem = assert_problem(client.put("/assets/splats", content=content.getvalue()))
    assert problem["type"] == "/problems/invalid-splats"
    assert "checkpoint" in problem["got"] and "ns-export" in problem["hint"]


def test_plan_comes_before_the_order_of_plain_views_a_rig_and_a_panorama(
    client: TestClient, scene_assets: SceneAssets
) -> None:
    jobs = client.get("/jobs").json()
    frame = cameras_document()["frames"][1] | {"file_path": "pano.jpg"}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 128, "h": 64, "frames": [frame]}
    panorama = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    rig, panorama_pack, other = (
        put(client, AssetKind.FEATURES, pack(views))
        for views in (
            {f"rig/{view}": view_labels for view, view_labels in labels().items()},
            {"pano": labels()["middle"]},
            {"rig/elsewhere": labels()["left"]},
        )
    )
    for scene, views in (
        (scene_assets, "3 of 3 views"),
        (replace(scene_assets, features=rig), "3 of 3 views"),
        (replace(scene_assets, cameras=panorama, features=panorama_pack), "6 of 6 views"),
    ):
        plan = client.post("/lift/plan", json=scene.order(preset="row-sum"))
        assert plan.status_code == 200, plan.text
        assert plan.json()["summary"][0].startswith("60 splats") and views in plan.json()["summary"][0]
    assert client.post("/lift/plan", json=scene_assets.order(preset="none")).status_code == 422
    problem = assert_problem(client.post("/lift", json=replace(scene_assets, features=other).order()))
    assert problem["status"] == 422
    assert "none in common" in problem["detail"] and "camA/000" in problem["detail"]
    assert client.get("/jobs").json() == jobs
    for asset in (rig, panorama_pack, other, panorama):
        assert client.delete(f"/assets/{asset}").status_code == 204
