"""A store and a supervisor whose children are stand-ins."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from service.jobs.limits import JobLimits
from service.jobs.supervisor import Supervisor
from service.models import ENDED, AssetKind
from service.store.assets import CheckedUpload
from service.store.jobs import JobOrder, JobRecord
from service.store.store import Store

Supervising = Callable[..., AbstractContextManager[Supervisor]]


def stand_in(behaviour: str) -> list[str]:
    """The command of a stand-in."""
    return [sys.executable, "-S", "-E", str(Path(__file__).with_name("stand_in.py")), behaviour]


def order(store: Store, **settings: Any) -> JobOrder:
    """An order over assets whose content nobody looks at."""
    ids = [asset_of(store, kind, {"names": ["v", "w"], "channels": 1}) for kind in [*AssetKind][:3]]
    return JobOrder(ids[0], ids[1], (ids[2],), settings)


def labels(store: Store) -> dict[str, Any]:
    """What a trade-off of that order may be judged by: masks of one of its two views."""
    masks = asset_of(store, AssetKind.MASKS, {"names": ["v"], "classes": 1})
    table = asset_of(store, AssetKind.TABLE, {"words": ["apple"], "channels": 1})
    return {"masks": masks, "table": table, "classes": ["apple"]}


def asset_of(store: Store, kind: AssetKind, counts: dict[str, Any]) -> str:
    """An asset whose content nobody looks at; its id."""
    with store.files.draft(".bin") as draft:
        draft.write_bytes(kind.encode())
        checked = CheckedUpload(draft, kind, kind.encode().hex().ljust(64, "0"), ".bin", counts, [])
        return store.assets.add(checked)[0].id


def until(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait for something that is about to happen."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


def ended(store: Store, job: str) -> JobRecord:
    """The job, once it has ended."""
    until(lambda: store.jobs.get(job).state in ENDED)
    return store.jobs.get(job)


def alive(pid: int) -> bool:
    """Whether a process runs; one that is dead and not yet reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store.open(tmp_path / "data")
    yield opened
    opened.close()


@pytest.fixture
def supervising(store: Store) -> Supervising:
    """Run a supervisor whose children behave as told."""

    @contextmanager
    def run(behaviour: str, **limits: Any) -> Iterator[Supervisor]:
        supervisor = Supervisor(store, JobLimits(**limits), command=stand_in(behaviour))
        supervisor.start()
        try:
            yield supervisor
        finally:
            supervisor.stop()

    return run
