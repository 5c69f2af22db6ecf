"""Uploads: one asset for the same bytes, however they come; downloads; no more than there is room."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from starlette.types import Message, Receive, Scope, Send

from service.models import AssetKind
from service.store.files import DataDirectory
from service.store.owners import SERVICE
from service.store.store import Store
from service.uploads import AssetIntake, Intake
from tests.crash.server import standing_in
from tests.tiny_scene import (
    TinyScene,
    ply,
    splat_rows,
)

from .conftest import SceneAssets, parts_of
from .test_problems import assert_problem


def test_packs_are_named_anew_as_assets_of_their_own(client: TestClient, scene_assets: SceneAssets) -> None:
    at = f"/assets/{scene_assets.features}"
    before = client.get(at).json()["counts"]
    renamed_pack = client.patch(at, json={"text_space": "words", "encoder": "a CNN"})
    assert renamed_pack.status_code == 201 and renamed_pack.headers["location"] != at
    assert renamed_pack.json()["counts"] == before | {"text_space": "words", "encoder": "a CNN"}
    assert client.patch(at, json={"text_space": "words", "encoder": "a CNN"}).status_code == 200
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


def test_upload_that_is_closed_before_its_thread_opens_it_leaves_no_draft(store: Store) -> None:
    intake = AssetIntake(store, SERVICE, AssetKind.SPLATS, 100)
    intake.close()
    intake.open()
    assert not list((store.files.root / "tmp").iterdir())
