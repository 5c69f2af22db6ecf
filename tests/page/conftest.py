"""A real server with a lift of the tiny scene, and a browser."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from service.__main__ import server_of
from service.app import assemble
from service.settings import ServiceSettings
from service.store.store import Store
from tests.api.following import ended
from tests.api.tiny_scene import make_scene
from tests.crash.conftest import until

from .browser import Browser, chromium


@dataclass(frozen=True)
class Served:
    """Where the service is, and its one lift."""

    address: str
    lift: str
    store: Store


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder, scene = tmp_path_factory.mktemp("page"), make_scene()
    (folder / "table.safetensors").write_bytes(scene.table)
    settings = ServiceSettings.model_validate(
        {"data": folder / "data", "encoder": f"table:{folder}/table.safetensors"}
    )
    store = Store.open(settings.data)
    listener = socket.create_server(("127.0.0.1", 0))
    server = server_of(assemble(settings, store), settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started)
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with httpx.Client(base_url=address, timeout=60) as client:
            put = {kind: getattr(scene, kind) for kind in ("splats", "cameras", "features")}
            ids = {kind: client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in put.items()}
            order = ids | {"features": [ids["features"]], "settings": {"preset": "row-sum"}}
            job = ended(client, client.post("/lift", json=order).headers["location"])
        assert job["state"] == "succeeded", job
        yield Served(address, job["id"], store)
    finally:
        server.should_exit = True
        thread.join()
        store.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    program = chromium()
    if program is None:
        pytest.skip("no Chromium on this machine")
    with Browser.started(program, Path(tmp_path_factory.mktemp("profile"))) as browser:
        yield browser
        assert browser.faults == []
