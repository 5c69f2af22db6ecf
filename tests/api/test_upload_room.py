"""What an upload may fill is looked at while it comes, however small it was made for the way."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from typing import Any, cast

import pytest
from fastapi.testclient import TestClient

from service.app import create_app, job_limits
from service.jobs.supervisor import Supervisor
from service.queries.client import QueryClient
from service.scopes import parse_scopes
from service.settings import ServiceSettings
from service.store.files import DataDirectory
from service.store.keys import Quota
from service.store.store import Store
from service.uploads.intake import Intake
from tests.crash.server import NoQueries

MiB = 1 << 20
BODY = gzip.compress(bytes(64 * MiB), 1)  # a few hundred kilobytes


@pytest.fixture
def most(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """The bytes of the largest draft so far."""
    written: list[int] = []
    original = Intake.close

    def close(intake: Intake) -> None:
        assert intake._file is not None
        written.append(intake._file.tell())
        original(intake)

    monkeypatch.setattr(Intake, "close", close)
    return lambda: max(written)


def put(store: Store, headers: dict[str, str]) -> Any:
    """Upload what decompresses to 64 MiB."""
    settings = ServiceSettings.model_validate({"data": store.files.root})
    app = create_app(settings, store, Supervisor(store, job_limits(settings)), cast("QueryClient", NoQueries()))
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        return client.put("/assets/splats", content=BODY, headers={"Content-Encoding": "gzip", **headers})


def test_disk_keeps_its_floor_when_the_body_is_compressed(
    store: Store, most: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    room = 10 * MiB

    def free(files: DataDirectory) -> int:
        return files.floor_bytes + room - sum(draft.stat().st_size for draft in (files.root / "tmp").glob("*.splats"))

    monkeypatch.setattr(DataDirectory, "free_bytes", free)
    reply = put(store, {})
    assert (reply.status_code, reply.json()["type"]) == (507, "/problems/no-space")
    assert 0 < most() <= room
    assert not any((store.files.root / "tmp").iterdir())


@pytest.mark.parametrize("left", [1, 10 * MiB])
def test_key_with_little_room_writes_no_large_draft(store: Store, most: Callable[[], int], left: int) -> None:
    _, secret = store.keys.create("small", parse_scopes(["write"]), Quota(max_bytes=left))
    reply = put(store, {"Authorization": f"Bearer {secret}"})
    assert (reply.status_code, reply.json()["type"]) == (403, "/problems/over-quota")
    assert most() <= left


@pytest.mark.parametrize(("full", "status"), [("quota", 403), ("disk", 507)])
def test_no_byte_is_taken_where_nothing_may_be_stored(
    store: Store, monkeypatch: pytest.MonkeyPatch, full: str, status: int
) -> None:
    taken: list[bytes] = []
    monkeypatch.setattr(Intake, "feed", lambda intake, chunk: taken.append(chunk))
    _, secret = store.keys.create("small", parse_scopes(["write"]), Quota(max_bytes=0 if full == "quota" else None))
    if full == "disk":
        monkeypatch.setattr(DataDirectory, "free_bytes", lambda files: files.floor_bytes - 1)
    assert put(store, {"Authorization": f"Bearer {secret}"}).status_code == status
    assert taken == []
