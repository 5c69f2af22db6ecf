"""Scenes of other kinds over HTTP: discs, an editor's file, a rig, a panorama, and photos of a lens that bends."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient
from PIL import Image
from plyfile import PlyData

from liftcore.io.splat import ROW
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.splats import Kernel
from service.models import AssetKind
from tests.distorted_scene import HEIGHT, VIEWS, WIDTH, photo_of, write_distorted_scene

from .conftest import Uploaded, put
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import (
    PROPERTIES,
    SPLATS_A_CLUSTER,
    TinyScene,
    cameras_document,
    labels,
    masks,
    pack,
    ply,
    splat_rows,
)

FILES = Path(__file__).parents[1] / "data" / "splats"
Lifting = Callable[..., str]


@pytest.fixture
def lifting(client: TestClient) -> Any:
    """Order lifts and wait for them; they and the assets that a test names are deleted after it."""
    jobs: list[str] = []
    assets: list[str] = []

    def run(order: dict[str, Any], *own: str) -> str:
        job = ended(client, client.post("/lift", json=order).headers["location"])
        assert job["state"] == "succeeded", job
        jobs.append(job["links"]["self"])
        assets.extend(own)
        return job["id"]

    yield run
    for job in jobs:
        assert client.delete(job, params={"with_lift": True}).status_code == 204
    for asset in assets:
        assert client.delete(f"/assets/{asset}").status_code == 204


# Kernels and formats


def discs() -> bytes:
    """The tiny scene with two scales a splat; unturned discs face its cameras."""
    kept = [name for name in PROPERTIES if name != "scale_2"]
    return ply(splat_rows()[:, [PROPERTIES.index(name) for name in kept]], kept)


def betas() -> bytes:
    """The tiny scene with colours of DBS, a shape a splat and one lobe."""
    names = [name.replace("f_dc", "sh0") for name in PROPERTIES]
    more = ["beta", *(f"sb_params_{i}" for i in range(6))]
    columns = np.zeros((len(splat_rows()), len(more)), np.float32)
    return ply(np.concatenate([splat_rows(), columns], axis=1), [*names, *more])


def editors_file() -> bytes:
    """The tiny scene as a ``.splat``."""
    given = splat_rows()
    rows = np.zeros(len(given), ROW)
    rows["means"], rows["scales"] = given[:, :3], np.exp(given[:, 7:10])
    rows["colours"][:, :3] = np.clip((given[:, 3:6] * SH_C0 + 0.5) * 255, 0, 255)
    rows["colours"][:, 3] = 255 / (1 + np.exp(-given[:, 6]))
    rows["quats"] = np.clip(given[:, 10:] * 128 + 128, 0, 255)
    return rows.tobytes()


@pytest.mark.parametrize(("kernel", "content"), [("2dgs", discs()), ("3dgs", editors_file())], ids=["2dgs", "splat"])
def test_scene_of_another_kind_is_lifted_and_answered_in_its_rows(
    client: TestClient, uploaded: Uploaded, lifting: Lifting, kernel: str, content: bytes
) -> None:
    warm_up(Kernel(kernel))  # compiles, where nobody has yet: that may take longer than `ended` waits
    asset = client.put("/assets/splats", content=content).json()
    assert asset["counts"]["kernel"] == kernel
    order = replace(uploaded, splats=asset["id"]).order(preset="row-sum", certificate_rays=0)
    asked = {"lift": lifting(order, asset["id"]), "text": "apple", "view": "middle", "threshold": 0.5}
    answer = client.get("/query", params=asked).json()
    scores = np.load(io.BytesIO(client.get(answer["links"]["scores"]).content), allow_pickle=False)
    assert set(np.argsort(-scores)[:SPLATS_A_CLUSTER]) == set(range(SPLATS_A_CLUSTER))
    found = PlyData.read(io.BytesIO(client.get(answer["links"]["object"]).content))
    assert np.array_equal(found["vertex"]["x"], splat_rows()[np.flatnonzero(scores >= 0.5), 0])
    for link in ("mask", "render"):
        assert client.get(answer["links"][link]).headers["content-type"] == "image/png"


@pytest.mark.parametrize(
    ("content", "settings", "argument", "said"),
    [
        (discs(), {"kernel": "3dgs"}, "kernel", "'scale_2'"),
        (discs(), {"kernel": "dbs"}, "kernel", "leave it out: the file speaks of 2dgs"),
        (betas(), {"antialiased": True}, "antialiased", "dbs"),
    ],
)
def test_kernel_that_does_not_fit_the_splats_is_refused_with_the_order(
    client: TestClient, uploaded: Uploaded, content: bytes, settings: dict[str, Any], argument: str, said: str
) -> None:
    asset = put(client, AssetKind.SPLATS, content)
    answer = client.post("/lift", json=replace(uploaded, splats=asset).order(**settings))
    assert assert_problem(answer)["type"] == "/problems/invalid-settings"
    assert argument in answer.json()["detail"] and said in answer.text
    assert client.delete(f"/assets/{asset}").status_code == 204


@pytest.mark.parametrize("name", ["degree3.compressed.ply", "degree3.v4.spz", "degree3.sog"])
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


# Cameras


def test_views_of_a_rig_are_planned_and_other_folders_refused(client: TestClient, uploaded: Uploaded) -> None:
    rig = put(client, AssetKind.FEATURES, pack({f"rig/{view}": found for view, found in labels().items()}))
    plan = client.post("/lift/plan", json=replace(uploaded, features=rig).order())
    assert plan.status_code == 200 and "3 of 3 views" in plan.json()["summary"][0]
    other = put(client, AssetKind.FEATURES, pack({"rig/elsewhere": labels()["left"]}))
    problem = assert_problem(client.post("/lift", json=replace(uploaded, features=other).order()))
    assert problem["status"] == 422
    assert "none in common" in problem["detail"] and "camA/000" in problem["detail"]
    for asset in (rig, other):
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_masks_of_a_rig_fit_and_may_not_take_every_view(
    client: TestClient, uploaded: Uploaded, scene: TinyScene
) -> None:
    every = put(client, AssetKind.MASKS, masks({f"rig/{view}": found[0] for view, found in labels().items()}))
    table = put(client, AssetKind.TABLE, scene.table)
    judged = {"masks": every, "table": table, "classes": ["apple", "book", "lamp"]}
    problem = assert_problem(client.post("/tradeoff", json=uploaded.order() | {"labels": judged}))
    assert problem["argument"] == "labels.masks" and "masks of all of them" in problem["detail"]
    for asset in (every, table):
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_panorama_is_lifted_and_asked_face_by_face(client: TestClient, uploaded: Uploaded, lifting: Lifting) -> None:
    frame = cameras_document()["frames"][1] | {"file_path": "pano.jpg"}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 128, "h": 64, "frames": [frame]}
    cameras = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    found = put(client, AssetKind.FEATURES, pack({"pano": labels()["middle"]}))
    lift = lifting(replace(uploaded, cameras=cameras, features=found).order(), cameras, found)
    assert sorted(client.get(f"/lifts/{lift}").json()["views"])[0] == "pano@back"
    assert client.get("/render", params={"lift": lift, "view": "pano@front"}).status_code == 200
    place = {"view": "pano@front", "x": 20, "y": 20}
    [region] = client.get(f"/lifts/{lift}/regions", params=place).json()["regions"]
    assert client.get("/query", params={"lift": lift, "like": region["example"]}).status_code == 200


def test_pictures_and_pixels_of_distorted_photos_are_of_the_photo(
    client: TestClient, lifting: Lifting, tmp_path: Path
) -> None:
    files = zip((*AssetKind,)[:3], write_distorted_scene(tmp_path, "barrel"), strict=True)
    own = [put(client, kind, path.read_bytes()) for kind, path in files]
    told = client.get(f"/assets/{own[1]}").json()
    assert (told["counts"]["distorted"], told["counts"]["sizes"]) == (len(VIEWS), [f"{WIDTH}x{HEIGHT}"])
    assert any("photos as they were taken" in warning for warning in told["warnings"])
    lift = lifting(Uploaded(*own).order(preset="row-sum"), *own)
    photo = photo_of("left", "barrel", 0.1)  # clear of the borders of its quarters
    photo[:20] = photo[-20:] = photo[:, :20] = photo[:, -20:] = -1  # and of the rim, of which the lift knows less
    for part in np.unique(photo[photo >= 0]):
        places = np.argwhere(photo == part)
        y, x = places[len(places) // 2]
        asked = {"lift": lift, "like": f"left:{x},{y}", "view": "left", "threshold": 0.5}
        mask = np.asarray(Image.open(io.BytesIO(client.get("/query/mask", params=asked).content))) > 0
        found, truth = mask & (photo >= 0), photo == part
        assert (found & truth).sum() / (found | truth).sum() > 0.99
    picture = client.get("/render", params={"lift": lift, "view": "left"})
    assert Image.open(io.BytesIO(picture.content)).size == (WIDTH, HEIGHT)
    beyond = assert_problem(client.get("/query", params={"lift": lift, "like": f"left:{WIDTH},0"}))
    assert f"x in 0..{WIDTH - 1} and y in 0..{HEIGHT - 1}" in beyond["detail"]
