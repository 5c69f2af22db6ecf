"""Splats of editors' formats over HTTP: taken where they hold no code, lifted, and answered as PLYs of their rows."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient
from plyfile import PlyData

from liftcore.io.splat import ROW
from liftcore.scene.harmonics import SH_C0

from .conftest import Uploaded
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import SPLATS_A_CLUSTER, splat_rows

FILES = Path(__file__).parents[1] / "data" / "splats"


def splat_bytes() -> bytes:
    """The tiny scene as a ``.splat``."""
    given = splat_rows()
    rows = np.zeros(len(given), ROW)
    rows["means"], rows["scales"] = given[:, :3], np.exp(given[:, 7:10])
    rows["colours"][:, :3] = np.clip((given[:, 3:6] * SH_C0 + 0.5) * 255, 0, 255)
    rows["colours"][:, 3] = 255 / (1 + np.exp(-given[:, 6]))
    rows["quats"] = np.clip(given[:, 10:] * 128 + 128, 0, 255)
    return rows.tobytes()


@pytest.mark.parametrize("name", ["degree3.compressed.ply", "degree3.splat", "degree3.v4.spz", "degree3.sog"])
def test_formats_that_hold_no_code_are_assets(client: TestClient, name: str) -> None:
    content = (FILES / name).read_bytes()
    reply = client.put("/assets/splats", content=content)
    assert reply.status_code == 201, reply.text
    asset = reply.json()
    assert asset["counts"]["splats"] == 40
    stored = client.get(f"/assets/{asset['id']}/content")
    assert stored.content == content
    assert stored.headers["content-disposition"].endswith(f'{Path(name).suffix}"')
    assert client.delete(f"/assets/{asset['id']}").status_code == 204


def test_splats_of_an_editor_are_lifted_and_answered_in_its_rows(client: TestClient, uploaded: Uploaded) -> None:
    splats = client.put("/assets/splats", content=splat_bytes()).json()["id"]
    order = replace(uploaded, splats=splats)
    job = ended(client, client.post("/lift", json=order.order(preset="row-sum")).headers["location"])
    assert job["state"] == "succeeded", job
    lift = client.get(job["links"]["lift"]).json()["id"]
    asked = {"lift": lift, "text": "apple"}
    scores = np.load(io.BytesIO(client.get("/query/scores", params=asked).content), allow_pickle=False)
    assert set(np.argsort(-scores)[:SPLATS_A_CLUSTER]) == set(range(SPLATS_A_CLUSTER))
    found = PlyData.read(io.BytesIO(client.get("/query/splats", params={**asked, "threshold": 0.5}).content))
    own = np.flatnonzero(scores >= 0.5)
    assert np.array_equal(found["vertex"]["x"], splat_rows()[own, 0])
    assert client.get("/query/mask", params={**asked, "view": "middle"}).status_code == 200
    refused = client.post("/lift", json=order.order(kernel="dbs"))
    assert assert_problem(refused)["type"] == "/problems/invalid-settings"


def test_checkpoints_are_refused_over_http_with_a_way_on(client: TestClient) -> None:
    content = io.BytesIO()
    torch.save({"splats": {"means": torch.zeros(2, 3)}}, content)
    reply = client.put("/assets/splats", content=content.getvalue())
    problem = assert_problem(reply)
    assert problem["type"] == "/problems/invalid-splats"
    assert "checkpoint" in problem["got"] and "ns-export" in problem["hint"]
