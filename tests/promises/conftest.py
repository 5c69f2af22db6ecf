"""One server for all promises of HTTP, with one lift of the tiny scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.server import Server
from tests.tiny_scene import CHANNELS, TinyScene, make_scene, text_table

from .over_http import lift_of, upload_scene


@pytest.fixture(scope="session")
def tiny() -> TinyScene:
    return make_scene()


@pytest.fixture(scope="session")
def encoder(tiny: TinyScene, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text encoder of the tiny scene's words."""
    path = tmp_path_factory.mktemp("encoder") / "table.safetensors"
    path.write_bytes(tiny.table)
    path.with_name("narrow.safetensors").write_bytes(text_table(CHANNELS - 3))
    return f"table:{path}"


@pytest.fixture(scope="session")
def server(encoder: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server for all tests that leave it as they found it."""
    spaces = {"narrow": encoder.replace("table.safetensors", "narrow.safetensors")}
    data = tmp_path_factory.mktemp("service") / "data"
    with Server(data, encoder=encoder, text_spaces=spaces, upload_bytes=200_000, max_queued=6) as server:
        yield server


@pytest.fixture(scope="session")
def client(server: Server) -> httpx.Client:
    return server.client


@pytest.fixture(scope="session")
def order(client: httpx.Client, tiny: TinyScene) -> dict[str, Any]:
    """The body of an order of a lift."""
    return upload_scene(client, tiny)


@pytest.fixture(scope="session")
def lift(client: httpx.Client, order: dict[str, Any]) -> dict[str, Any]:
    """The lift of that order, as GET /lifts/{id} describes it."""
    return lift_of(client, order)
