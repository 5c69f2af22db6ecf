"""What an upload and a lift tell of themselves, and where their files are found again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.query.scene import QueryScene

from .conftest import LIFT_REQUEST, Uploaded
from .tiny_scene import CHANNELS, SPLATS_A_CLUSTER, VIEWS

COUNT = 3 * SPLATS_A_CLUSTER


def test_assets_say_what_is_in_them_and_their_names_alone(client: TestClient, uploaded: Uploaded) -> None:
    listed = {asset["id"]: asset["counts"] for asset in client.get("/assets").json()["assets"]}
    splats, cameras, features = (
        client.get(f"/assets/{asset}").json()["counts"]
        for asset in (uploaded.splats, uploaded.cameras, uploaded.features)
    )
    assert (splats["splats"], splats["kernel"]) == (COUNT, "3dgs")
    assert (cameras["views"], features["channels"], features["text_space"]) == (len(VIEWS), CHANNELS, "tiny")
    for asset, counts in ((uploaded.cameras, cameras), (uploaded.features, features)):
        assert "middle" in counts.pop("names") and listed[asset] == counts  # lists leave out the names


def test_job_tells_its_story(client: TestClient, lift: dict[str, Any], uploaded: Uploaded) -> None:
    job = client.get(lift["links"]["job"]).json()
    assert (job["state"], job["attempt"], job["problem"]) == ("succeeded", 1, None)
    assert job["splats"] == uploaded.splats and job["features"] == [uploaded.features]
    assert job["settings"]["preset"] == "row-sum" and job["settings"]["power"] == 1
    assert job["created"] <= job["started"] <= job["ended"]
    assert job["id"] in {found["id"] for found in client.get("/jobs").json()["jobs"]}
    assert job["request_id"] == LIFT_REQUEST
    assert LIFT_REQUEST in client.get(job["links"]["events"]).text


def test_lift_tells_how_far_to_trust_it(client: TestClient, lift: dict[str, Any], uploaded: Uploaded) -> None:
    assert (lift["count"], lift["channels"], lift["text_space"]) == (COUNT, CHANNELS, "tiny")
    assert sorted(lift["views"]) == sorted(VIEWS) and lift["certificate"] and lift["timings"]
    assert (lift["splats"], lift["cameras"], lift["features"]) == (
        uploaded.splats, uploaded.cameras, [uploaded.features]
    )  # fmt: skip
    assert lift in client.get("/lifts").json()["lifts"]


def test_lift_and_its_files_are_found_where_they_were_downloaded(
    client: TestClient, data: Path, lift: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = client.get(lift["links"]["features"])
    assert len(whole.content) == lift["bytes"] and whole.headers["etag"] == f'"{lift["sha256"]}"'
    files = [f"/assets/{asset}/content" for asset in (lift["splats"], lift["cameras"], *lift["features"])]
    for reply in (whole, *map(client.get, files)):
        name = reply.headers["content-disposition"].partition('filename="')[2].rstrip('"')
        (tmp_path / name).write_bytes(reply.content)
    [made] = tmp_path.glob("lift-*.safetensors")
    assert str(data).encode() not in made.read_bytes()  # paths of the server are nobody's business
    monkeypatch.chdir(tmp_path)
    scene = QueryScene.open(made)
    assert scene.splats.count == COUNT and {camera.name for camera in scene.cameras.values()} == set(VIEWS)
    assert set(scene.packs.views) == set(VIEWS)
