"""GET /lifts tells of the lifts that are here, whatever is deleted meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.store.jobs import JobStore

from .conftest import Uploaded


def test_list_does_not_look_up_jobs_that_may_be_gone(
    client: TestClient, lift: dict[str, Any], uploaded: Uploaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    original: Callable[..., Any] = JobStore.get

    def get(store: JobStore, job: str) -> Any:
        looked.append(job)
        return original(store, job)

    monkeypatch.setattr(JobStore, "get", get)
    (found,) = [entry for entry in client.get("/lifts").json()["lifts"] if entry["id"] == lift["id"]]
    assert found == lift and not looked
    assert (found["splats"], found["cameras"], found["features"]) == (
        uploaded.splats,
        uploaded.cameras,
        [uploaded.features],
    )
