"""The service pairs views with cameras by the same rule as the lift: folders before a name may be left out."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from service.models import AssetKind

from .following import ended
from .test_labels import put
from .test_problems import assert_problem
from .tiny_scene import cameras_document, labels, masks, pack

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

    from .conftest import Uploaded
    from .tiny_scene import TinyScene


def test_views_of_a_rig_are_lifted_over_http(client: TestClient, uploaded: Uploaded) -> None:
    rig = put(client, AssetKind.FEATURES, pack({f"rig/{view}": found for view, found in labels().items()}))
    job = ended(client, client.post("/lift", json=uploaded.order() | {"features": [rig]}).headers["location"])
    assert job["state"] == "succeeded", job
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(f"/assets/{rig}").status_code == 204


def test_panorama_is_lifted_face_by_face(client: TestClient, uploaded: Uploaded) -> None:
    frame = cameras_document()["frames"][1] | {"file_path": "pano.jpg"}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 128, "h": 64, "frames": [frame]}
    cameras = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    found = put(client, AssetKind.FEATURES, pack({"pano": labels()["middle"]}))
    order = uploaded.order() | {"cameras": cameras, "features": [found]}
    job = ended(client, client.post("/lift", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    assert sorted(client.get(f"/lifts/{job['id']}").json()["views"])[0] == "pano@back"
    asked = {"lift": job["id"], "view": "pano@front"}
    assert client.get("/render", params=asked).status_code == 200
    place = {"view": "pano@front", "x": 20, "y": 20}
    [region] = client.get(f"/lifts/{job['id']}/regions", params=place).json()["regions"]
    assert client.get("/query", params={"lift": job["id"], "like": region["example"]}).status_code == 200
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    for asset in (cameras, found):
        assert client.delete(f"/assets/{asset}").status_code == 204


def test_other_folders_and_no_folders_are_refused_at_once(client: TestClient, uploaded: Uploaded) -> None:
    other = put(client, AssetKind.FEATURES, pack({"rig/elsewhere": labels()["left"]}))
    problem = assert_problem(client.post("/lift", json=uploaded.order() | {"features": [other]}))
    assert problem["status"] == 422
    assert "none in common" in problem["detail"] and "camA/000" in problem["detail"]
    assert client.delete(f"/assets/{other}").status_code == 204


def test_masks_of_a_rig_fit_and_may_not_take_every_view(
    client: TestClient, uploaded: Uploaded, scene: TinyScene
) -> None:
    every = put(client, AssetKind.MASKS, masks({f"rig/{view}": found[0] for view, found in labels().items()}))
    table = put(client, AssetKind.TABLE, scene.table)
    judged = {"masks": every, "table": table, "classes": ["apple", "book", "lamp"]}
    problem = assert_problem(client.post("/tradeoff", json=uploaded.order() | {"labels": judged}))
    assert (problem["argument"], "masks of all of them" in problem["detail"]) == ("labels.masks", True)
    for asset in (every, table):
        assert client.delete(f"/assets/{asset}").status_code == 204
