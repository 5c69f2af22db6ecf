"""A real server with a lift of the tiny scene, and a browser."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import BrowserContext, sync_playwright

from service.app import create_app
from service.commands.serve import bind, server_of
from service.settings import ServiceSettings
from service.store import Store
from tests.promises.over_http import lift_of, upload_scene
from tests.server import until
from tests.tiny_scene import make_scene

from .browser import PATIENCE_SECONDS, Browser, Chromium, launch, profile


@dataclass(frozen=True)
class PageServer:
    """A running service: address, lift, data directory, and a client."""

    address: str
    lift: str
    data: Path
    client: httpx.Client


@contextlib.contextmanager
def serving(data: Path, **settings: Any) -> Iterator[str]:
    """A server in a thread and on a free port: its address."""
    server_settings = ServiceSettings.model_validate({"data": data, "disk_floor_bytes": 0, **settings})
    addresses: list[str] = []
    with contextlib.closing(Store(data)) as store, contextlib.closing(bind("127.0.0.1", 0)) as listener:
        server = server_of(create_app(server_settings, store), server_settings, addresses.append)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            until(lambda: addresses)
            yield addresses[0]
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def server(chromium: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PageServer]:
    folder, scene = tmp_path_factory.mktemp("page"), make_scene()
    (folder / "table.safetensors").write_bytes(scene.table)
    with (
        serving(folder / "data", encoder=f"table:{folder}/table.safetensors") as address,
        httpx.Client(base_url=address, timeout=PATIENCE_SECONDS) as client,
    ):
        lift = lift_of(client, upload_scene(client, scene))
        yield PageServer(address, lift["id"], folder / "data", client)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Chromium]:
    with sync_playwright() as playwright, launch(playwright.chromium) as chromium:
        yield chromium


@pytest.fixture(scope="module")
def context(chromium: Chromium) -> Iterator[BrowserContext]:
    with profile(chromium) as context:
        yield context


@pytest.fixture
def browser(context: BrowserContext) -> Iterator[Browser]:
    with Browser.open_window(context) as browser:
        yield browser
