"""A disk that is really full: 507, nothing half done, and the service lives."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.jobs.process import JobLimits
from service.jobs.supervisor import Supervisor
from service.queries.client import QueryClient
from service.settings import ServiceSettings
from service.store.store import Store

from .conftest import ended, order, stand_in
from .server import NoQueries


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of two megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "none", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("mounting a small file system takes rights that this user lacks")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_full_disk_is_507_and_the_service_lives(small_disk: Path) -> None:
    store = Store.open(small_disk / "data")
    known = order(store)
    body = {"splats": known.splats, "cameras": known.cameras, "features": list(known.features)}
    settings = ServiceSettings.model_validate({"data": small_disk / "data"})
    runner = Supervisor(store, JobLimits(), command=stand_in("answer"))
    app = create_app(settings, store, runner, cast("QueryClient", NoQueries()))
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        upload = client.put("/assets/splats", content=b"x" * 4_000_000)
        assert (upload.status_code, upload.json()["type"]) == (507, "/problems/no-space")
        assert not any((small_disk / "data" / "tmp").iterdir())
        filler = small_disk / "filler"
        with filler.open("wb", buffering=0) as handle, pytest.raises(OSError, match="space"):
            while True:
                handle.write(b"x" * 4096)
        replies = [client.post("/lift", json=body).status_code for _ in range(20)]
        assert replies[-1] == 507 and set(replies) <= {202, 507}
        assert client.get("/healthz").status_code == 200
        filler.unlink()
        acknowledged = [job["id"] for job in client.get("/jobs").json()["jobs"]]
        assert len(acknowledged) == replies.count(202)
        reply = client.post("/lift", json=body)
        assert reply.status_code == 202
        assert ended(store, reply.json()["id"]).state == "succeeded"
        assert {ended(store, job).state for job in acknowledged} <= {"succeeded", "failed"}
    store.close()
