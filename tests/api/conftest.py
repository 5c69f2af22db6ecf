"""A running application around a data directory of its own, and a scene that was lifted through it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import tasks
from service.models import AssetKind
from service.state import AppState
from service.store.assets import CheckedUpload
from service.store.owners import SERVICE
from service.store.store import Store
from tests import server
from tests.server import wait_for_end
from tests.tiny_scene import CHANNELS, TinyScene, make_scene, text_table

LIFT_REQUEST = "the-request-of-the-lift"


def serving(data: Path, table: Path, **settings: Any) -> AbstractContextManager[TestClient]:
    """The application over a data directory, with the text table of the tiny scene."""
    spaces = {"spare": f"table:{table.with_name('narrow.safetensors')}"}
    return server.serving(data, encoder=f"table:{table}", text_spaces=spaces, **settings)


def app_of(client: TestClient) -> FastAPI:
    """Return the application that a client calls."""
    assert isinstance(client.app, FastAPI)
    return client.app


def parts_of(client: TestClient) -> AppState:
    """Return the parts of a client's application."""
    return app_of(client).state.deps


def put(client: TestClient, kind: AssetKind, content: bytes) -> str:
    """Store what the check takes, without a process; the id."""
    store = parts_of(client).store
    with store.files.draft(".part") as draft, store.files.scratch() as folder:
        draft.write_bytes(content)
        copy = folder / "copy"
        copy.write_bytes(content)
        report = tasks.check(kind, str(copy))
        digest = hashlib.sha256(content).hexdigest()
        upload = CheckedUpload(draft, kind, digest, report["suffix"], report["counts"], report["warnings"])
        return store.assets.add(SERVICE, upload)[0].id


@dataclass(frozen=True)
class SceneAssets:
    """The ids of the tiny scene's assets."""

    splats: str
    cameras: str
    features: str

    def order(self, **settings: Any) -> dict[str, Any]:
        """The body of a POST /lift."""
        return {
            "splats": self.splats,
            "cameras": self.cameras,
            "features": [self.features],
            "settings": settings,
        }


@pytest.fixture(scope="session")
def scene() -> TinyScene:
    return make_scene()


@pytest.fixture(scope="session")
def table(scene: TinyScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("encoder") / "table.safetensors"
    path.write_bytes(scene.table)
    path.with_name("narrow.safetensors").write_bytes(text_table(CHANNELS - 3))  # of another space
    return path


@pytest.fixture
def start(tmp_path: Path, table: Path) -> Callable[..., Any]:
    """Start applications with other settings, each over the test's own data directory."""
    return lambda folder="data", **settings: serving(tmp_path / folder, table, **settings)


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service") / "data"


@pytest.fixture(scope="session")
def client(data: Path, table: Path) -> Iterator[TestClient]:
    """One application for all tests that leave it as they found it."""
    with serving(data, table, max_splats_bytes=200_000) as client:
        yield client


@pytest.fixture(scope="session")
def scene_assets(client: TestClient, scene: TinyScene) -> SceneAssets:
    replies = [
        client.put("/assets/splats", content=scene.splats),
        client.put("/assets/cameras", content=scene.cameras),
        client.put("/assets/features", content=scene.features),
    ]
    for reply in replies:
        assert reply.status_code == 201, reply.text
    return SceneAssets(*(reply.json()["id"] for reply in replies))


@pytest.fixture(scope="session")
def lift(client: TestClient, scene_assets: SceneAssets) -> dict[str, Any]:
    """The lift of the tiny scene, as GET /lifts/{id} tells it."""
    reply = client.post("/lift", json=scene_assets.order(preset="row-sum"), headers={"X-Request-ID": LIFT_REQUEST})
    assert reply.status_code == 202, reply.text
    job = wait_for_end(client, reply.headers["location"])
    assert job["state"] == "succeeded", job
    return client.get(job["links"]["lift"]).json()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store that no application holds."""
    new_store = Store.open(tmp_path / "data")
    yield new_store
    new_store.close()
