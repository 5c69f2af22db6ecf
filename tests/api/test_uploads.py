"""Uploads: one asset for the same bytes, however they come; downloads; no more than there is room."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi.testclient import TestClient
from starlette.types import Message, Receive, Scope, Send

from liftcore.evaluate.inspect import inspect_file
from liftcore.io import safetensors_file
from service.models import AssetKind
from service.routes import assets
from service.store.files import DataDirectory
from service.store.keys import Quota
from service.store.owners import SERVICE, parse_scopes
from service.store.store import Store
from service.uploads import STEP, AssetIntake, Intake
from tests.crash.server import standing_in
from tests.tiny_scene import (
    TinyScene,
    ply,
    splat_rows,
    text_table,
)

from .conftest import SceneAssets, parts_of
from .test_problems import assert_problem


def test_same_bytes_are_the_same_asset_however_they_come(
    client: TestClient, scene_assets: SceneAssets, scene: TinyScene
) -> None:
    digest, half = hashlib.sha256(scene.splats).hexdigest(), len(scene.splats) // 2
    pieces = (part for part in (scene.splats[:half], scene.splats[half:]))  # of unknown number
    reply = client.put("/assets/splats", content=pieces, params={"sha256": digest.upper()})
    assert (reply.status_code, reply.json()["id"]) == (200, scene_assets.splats)
    assert scene_assets.splats == f"sha256:{digest}"


def test_asset_is_posted_with_its_kind_and_no_form_is_taken(client: TestClient, scene_assets: SceneAssets) -> None:
    content = client.get(f"/assets/{scene_assets.cameras}/content").content
    second = client.post("/assets", params={"kind": "cameras"}, content=content)
    assert (second.status_code, second.json()["id"]) == (200, scene_assets.cameras)
    assert client.post("/assets", content=content).status_code == 422
    assert client.post("/assets", params={"kind": "camera"}, content=content).status_code == 422
    for method, path in (("PUT", "/assets/cameras"), ("POST", "/assets?kind=cameras"), ("POST", "/lifts")):
        problem = assert_problem(client.request(method, path, files={"file": content}))
        assert (problem["status"], problem["argument"]) == (415, "Content-Type"), path
        assert "curl -T" in problem["hint"]


def test_packs_are_named_anew_as_assets_of_their_own(client: TestClient, scene_assets: SceneAssets) -> None:
    at = f"/assets/{scene_assets.features}"
    before = client.get(at).json()["counts"]
    renamed_pack = client.patch(at, json={"text_space": "minilm", "encoder": "a CNN"})
    assert renamed_pack.status_code == 201 and renamed_pack.headers["location"] != at
    assert renamed_pack.json()["counts"] == before | {"text_space": "minilm", "encoder": "a CNN"}
    assert client.patch(at, json={"text_space": "minilm", "encoder": "a CNN"}).status_code == 200
    assert client.patch(at, json={}).json()["id"] == scene_assets.features
    assert client.get(at).json()["counts"] == before
    assert_problem(client.patch(f"/assets/{scene_assets.splats}", json={"encoder": "x"}))
    for wrong in ({"encoder": ""}, {"text_space": "a\nb"}, {"words": "x"}):
        assert assert_problem(client.patch(at, json=wrong))["status"] == 422


def test_pack_that_was_damaged_or_lost_on_the_disk_is_not_named_anew(client: TestClient, scene: TinyScene) -> None:
    pack = scene.features.replace(b"by hand", b"by foot")
    asset = client.put("/assets/features", content=pack).json()["id"]
    (path,) = (parts_of(client).store.files.root / "blobs").glob(f"*/{asset.removeprefix('sha256:')}*")
    path.write_bytes(bytes(len(pack)))
    problem = assert_problem(client.patch(f"/assets/{asset}", json={"encoder": "x"}))
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-features") and str(path) not in str(
        problem
    )
    path.unlink()
    assert assert_problem(client.patch(f"/assets/{asset}", json={"encoder": "x"}))["status"] == 404
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_pack_that_takes_too_long_to_rename_gives_the_error_of_a_slow_upload(
    client: TestClient, scene_assets: SceneAssets, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(assets, "run_sandboxed", lambda *arguments: None)
    problem = assert_problem(client.patch(f"/assets/{scene_assets.features}", json={"encoder": "slow"}))
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-features")
    assert "takes longer" in problem["got"]


def test_long_header_of_a_pack_is_changed_outside_of_the_server(
    client: TestClient, scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    length = int.from_bytes(scene.features[:8], "little")
    header = scene.features[8 : 8 + length] + b" " * (16 << 20)
    long = len(header).to_bytes(8, "little") + header + scene.features[8 + length :]
    at = f"/assets/{client.put('/assets/features', content=long).json()['id']}"
    chunk_sizes: list[int] = []
    feed = AssetIntake.feed
    monkeypatch.setattr(
        AssetIntake, "feed", lambda intake, block: (chunk_sizes.append(len(block)), feed(intake, block))[1]
    )
    monkeypatch.setattr(safetensors_file, "with_metadata", Mock(side_effect=AssertionError("in the server")))
    renamed_pack = client.patch(at, json={"encoder": "another"})
    assert renamed_pack.status_code == 201 and renamed_pack.json()["counts"]["encoder"] == "another"
    assert sum(chunk_sizes) < 1 << 20  # what it begins with is padded no more


def test_error_of_a_file_of_another_kind_names_the_right_route(client: TestClient, scene: TinyScene) -> None:
    problem = assert_problem(client.put("/assets/splats", content=scene.cameras))
    assert "cameras" in problem["got"] and "/assets/cameras" in problem["hint"]


def test_asset_keeps_the_warnings_of_inspect(client: TestClient, tmp_path: Path) -> None:
    (tmp_path / "table").write_bytes(text_table(words=("apple", "book", "the Apple")))
    warnings = inspect_file(tmp_path / "table")["warnings"]
    asset = client.put("/assets/table", content=(tmp_path / "table").read_bytes())
    assert asset.status_code == 201 and asset.json()["warnings"] == warnings != []
    assert client.get(asset.headers["location"]).json()["warnings"] == warnings
    assert client.delete(asset.headers["location"]).status_code == 204


@pytest.mark.parametrize(
    ("headers", "status", "part"),
    [
        ({}, 200, slice(None)),
        ({"Range": "bytes=0-3"}, 206, slice(0, 4)),
        ({"Range": "bytes=10-"}, 206, slice(10, None)),
        ({"Range": "bytes=-7"}, 206, slice(-7, None)),
        ({"Range": "bytes=1_0-+12"}, 200, slice(None)),
        ({"Range": "bytes=5-2"}, 200, slice(None)),  # malformed ranges are ignored, as RFC 9110 says
        ({"Range": "lines=0-3"}, 200, slice(None)),
        ({"Range": "bytes=0-1,4-5"}, 200, slice(None)),  # several ranges may be answered with the whole
        ({"Range": "bytes=0-" + "9" * 5000}, 200, slice(None)),
        ({"Range": "bytes=0-3", "If-Range": '"another"'}, 200, slice(None)),
        ({"Range": "bytes=999999-"}, 416, None),
        ({"Range": "bytes=-0"}, 416, None),
        ({"Range": "bytes=" + "9" * 5000 + "-"}, 416, None),
        ({"If-None-Match": "{tag}"}, 304, slice(0)),
        ({"If-None-Match": '"other", {tag}'}, 304, slice(0)),
        ({"If-None-Match": "W/{tag}"}, 304, slice(0)),
        ({"If-None-Match": "*"}, 304, slice(0)),
    ],
)
def test_content_is_sent_whole_in_parts_or_not_again(
    client: TestClient,
    scene_assets: SceneAssets,
    scene: TinyScene,
    headers: dict[str, str],
    status: int,
    part: slice | None,
) -> None:
    tag = f'"{scene_assets.splats.removeprefix("sha256:")}"'
    request_headers = {name: value.replace("{tag}", tag) for name, value in headers.items()}
    reply = client.get(f"/assets/{scene_assets.splats}/content", headers=request_headers)
    assert reply.status_code == status
    if part is None:
        assert assert_problem(reply)["type"] == "/problems/range-not-satisfiable"
        assert reply.headers["content-range"] == f"bytes */{len(scene.splats)}"
    else:
        assert (reply.content, reply.headers["etag"]) == (scene.splats[part], tag)


def test_asset_in_use_stays(client: TestClient, scene_assets: SceneAssets, lift: dict[str, object]) -> None:
    for asset in (scene_assets.splats, scene_assets.cameras, scene_assets.features):
        reply = client.delete(f"/assets/{asset}")
        assert (reply.status_code, reply.json()["type"]) == (409, "/problems/in-use")
        assert str(lift["id"]) in reply.json()["hint"]
        assert client.get(f"/assets/{asset}/content").status_code == 200


@pytest.mark.parametrize("remaining", [None, b"", b"another"])
def test_damaged_file_is_reported_and_an_upload_repairs_it(
    client: TestClient, data: Path, remaining: bytes | None
) -> None:
    rows = splat_rows()
    rows[:, 1] += 0.5
    content = ply(rows)
    path = client.put("/assets/splats", content=content).headers["location"]
    [blob] = (data / "blobs").glob(f"*/{path.removeprefix('/assets/sha256:')}*")
    blob.unlink() if remaining is None else blob.write_bytes(remaining)
    assert assert_problem(client.get(f"{path}/content"))["status"] == 404
    assert client.put("/assets/splats", content=content).status_code == 200
    assert client.get(f"{path}/content").content == content
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == client.delete(path).status_code == 404


MiB = 1 << 20


@pytest.fixture
def largest_draft(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """The bytes of the largest draft so far."""
    sizes: list[int] = []
    original = Intake.close

    def close(intake: Intake) -> None:
        sizes.append(0 if intake._file is None else intake._file.tell())
        original(intake)

    monkeypatch.setattr(Intake, "close", close)
    return lambda: max(sizes, default=0)


def put(store: Store, headers: dict[str, str]) -> Any:
    """Upload 64 MiB, whose number nobody says before, in pieces of one; a test client would join them."""

    def pieces() -> Iterator[dict[str, Any]]:
        for remaining in reversed(range(64)):
            yield {"type": "http.request", "body": bytes(MiB), "more_body": remaining > 0}
        yield {"type": "http.disconnect"}

    with standing_in(store, "answer", disk_floor_bytes=1 << 30) as (client, _):
        app, body = client.app, pieces()

        async def in_pieces(scope: Scope, receive: Receive, send: Send) -> None:
            async def piece() -> Message:
                return next(body)

            await app(scope, piece, send)

        client._transport.app = in_pieces  # pyright: ignore[reportAttributeAccessIssue]
        return client.put("/assets/splats", headers=headers)


def test_disk_keeps_its_floor_when_the_body_is_of_unknown_length(
    store: Store, largest_draft: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    free_bytes = 10 * MiB

    def free(files: DataDirectory) -> int:
        return (
            files.floor_bytes
            + free_bytes
            - sum(draft.stat().st_size for draft in (files.root / "tmp").glob("*.splats"))
        )

    monkeypatch.setattr(DataDirectory, "free_bytes", free)
    assert assert_problem(put(store, {}))["type"] == "/problems/no-space"
    assert 0 < largest_draft() <= free_bytes
    assert not any((store.files.root / "tmp").iterdir())


@pytest.mark.parametrize("remaining", [0, 1, 10 * MiB])
def test_key_with_little_room_writes_no_large_draft(
    store: Store, largest_draft: Callable[[], int], remaining: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not remaining:  # not a byte is taken
        monkeypatch.setattr(Intake, "feed", Mock(side_effect=AssertionError))
    _, secret = store.keys.create("small", parse_scopes(["write"]), Quota(max_bytes=remaining))
    reply = put(store, {"Authorization": f"Bearer {secret}"})
    assert assert_problem(reply)["type"] == "/problems/over-quota"
    assert largest_draft() <= remaining
    assert (largest_draft() > 0) == (remaining > STEP)


def test_upload_that_is_closed_before_its_thread_opens_it_leaves_no_draft(store: Store) -> None:
    intake = AssetIntake(store, SERVICE, AssetKind.SPLATS, 100)
    intake.close()
    intake.open()
    assert not list((store.files.root / "tmp").iterdir())
