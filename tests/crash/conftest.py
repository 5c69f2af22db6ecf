"""A store and a supervisor whose children are stand-ins."""

from __future__ import annotations

import hashlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI

from service.commands.serve import bind, server_of
from service.models import FINAL_STATES, AssetKind
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.jobs import JobOrder, JobRecord
from service.store.owners import SERVICE, Owner
from service.store.store import Store
from service.supervisor import Clock, JobLimits, Supervisor

METADATA = {"views": [], "diagnostics": {}}  # all that the store asks of a lift's
Supervising = Callable[..., AbstractContextManager[Supervisor]]


def stand_in(behaviour: str) -> list[str]:
    """The command of a stand-in."""
    return [sys.executable, "-S", "-E", str(Path(__file__).with_name("stand_in.py")), behaviour]


def order(store: Store, owner: Owner = SERVICE, **settings: Any) -> JobOrder:
    """An order over assets whose content nobody looks at."""
    ids = [asset_of(store, kind, {"names": ["v", "w"], "channels": 1}, owner) for kind in [*AssetKind][:3]]
    return JobOrder(ids[0], ids[1], (ids[2],), settings)


def labels(store: Store, owner: Owner = SERVICE) -> dict[str, Any]:
    """Return labels for a trade-off of that order: masks of one of its two views."""
    masks = asset_of(store, AssetKind.MASKS, {"names": ["v"], "classes": 1}, owner)
    table = asset_of(store, AssetKind.TABLE, {"words": ["apple"], "channels": 1}, owner)
    return {"masks": masks, "table": table, "classes": ["apple"]}


def asset_of(store: Store, kind: AssetKind, counts: dict[str, Any], owner: Owner = SERVICE) -> str:
    """An asset whose content nobody looks at; its id."""
    with store.files.draft(".bin") as draft:
        draft.write_bytes(kind.encode())
        upload = CheckedUpload(draft, kind, hashlib.sha256(kind.encode()).hexdigest(), ".bin", counts, [])
        return store.assets.add(owner, upload)[0].id


def often(**overrides: float) -> ServiceSettings:
    """Settings of a collector that looks all the time and spares nothing."""
    return ServiceSettings.model_validate({"garbage_seconds": 0.02, "garbage_grace_seconds": 0.0, **overrides})


def until(condition: Callable[[], Any], seconds: float = 600.0) -> None:
    """Wait for something that is about to happen: at once, but for a machine that has other things to do."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


@contextmanager
def listening(app: FastAPI, settings: ServiceSettings) -> Iterator[uvicorn.Server]:
    """The service's server of an application, in a thread and on a free port: see `address_of`."""
    listener = bind("127.0.0.1", 0)
    server = server_of(app, settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started)
        yield server
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def address_of(server: uvicorn.Server) -> tuple[str, int]:
    """Host and port at which it listens."""
    return server.servers[0].sockets[0].getsockname()


def wait_until_ended(store: Store, job: str) -> JobRecord:
    """The job, once it has ended."""
    until(lambda: store.jobs.get(SERVICE, job).state in FINAL_STATES)
    return store.jobs.get(SERVICE, job)


def state_of(pid: int) -> str:
    """The state of a process as Linux has it: R, S, T (stopped), Z (dead and not yet reaped); X when it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "X"


def alive(pid: int) -> bool:
    """Return True if a process runs."""
    return state_of(pid) not in ("Z", "X")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened_store = Store.open(tmp_path / "data")
    yield opened_store
    opened_store.close()


@contextmanager
def supervised(store: Store, behaviour: str, *, clock: Clock = time.monotonic, **limits: Any) -> Iterator[Supervisor]:
    """Run a supervisor whose children behave like the stand-in that is named."""
    supervisor = Supervisor(store, JobLimits(**limits), command=stand_in(behaviour), clock=clock)
    supervisor.start()
    try:
        yield supervisor
    finally:
        supervisor.stop()


@pytest.fixture
def supervising(store: Store) -> Supervising:
    """The same over the test's own store."""
    return partial(supervised, store)
