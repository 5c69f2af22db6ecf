"""Scenes of other kinds over HTTP: discs and betas, files of editors, rigs and panoramas."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient

from service.models import AssetKind
from tests.tiny_scene import (
    PROPERTIES,
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


@pytest.mark.parametrize("name", ["degree3.compressed.ply", "degree3.v4.spz", "degree3.sog", "degree3.glb"])
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
