"""A real server with a lift of the tiny scene, and a browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import sync_playwright

from service.app import assemble
from service.settings import ServiceSettings
from service.store.store import Store
from tests.crash.conftest import address_of, listening
from tests.server import wait_for_end
from tests.tiny_scene import make_scene

from .browser import Browser, Chromium, launch


@dataclass(frozen=True)
class PageServer:
    """Address, lift and store of a running service."""

    address: str
    lift: str
    store: Store


@contextlib.contextmanager
def serving(data: Path, **settings: Any) -> Iterator[tuple[str, Store]]:
    """A server on a free port: its address and its store."""
    server_settings = ServiceSettings.model_validate({"data": data, "disk_floor_bytes": 0, **settings})
    store = Store.open(server_settings.data)
    try:
        with listening(assemble(server_settings, store), server_settings) as server:
            yield "http://{}:{}".format(*address_of(server)), store
    finally:
        store.close()


@pytest.fixture(scope="module")
def server(chromium: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PageServer]:
    folder, scene = tmp_path_factory.mktemp("page"), make_scene()
    (folder / "table.safetensors").write_bytes(scene.table)
    with serving(folder / "data", encoder=f"table:{folder}/table.safetensors") as (address, store):
        with httpx.Client(base_url=address, timeout=60) as client:
            bodies = {kind: getattr(scene, kind) for kind in ("splats", "cameras", "features")}
            ids = {kind: client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in bodies.items()}
            order = ids | {"features": [ids["features"]], "settings": {"preset": "row-sum", "objects": True}}
            job = wait_for_end(client, client.post("/lift", json=order).headers["location"])
        assert job["state"] == "succeeded", job
        yield PageServer(address, job["id"], store)


@pytest.fixture
def other_lift(server: PageServer) -> Iterator[str]:
    """Another lift of the same scene."""
    with httpx.Client(base_url=server.address, timeout=60) as client:
        lift_document = client.get(f"/lifts/{server.lift}").json()
        order = {name: lift_document[name] for name in ("splats", "cameras", "features")}
        order["settings"] = {"preset": "tikhonov"}
        job = wait_for_end(client, client.post("/lift", json=order).headers["location"])["id"]
        yield job
        assert client.delete(f"/jobs/{job}?with_lift=true").status_code == 204


@pytest.fixture(scope="module")
def chromium() -> Iterator[Chromium]:
    with sync_playwright() as playwright, launch(playwright.chromium) as chromium:
        yield chromium


@pytest.fixture
def browser(chromium: Chromium) -> Iterator[Browser]:
    with Browser.open_window(chromium) as browser:
        yield browser
