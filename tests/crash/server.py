"""The service without queries, as a process that kills itself at a named point.

    python -m tests.crash.server DATA [--behaviour NAME] [--point NAME]

The point is a place in the service's own code, wrapped here: the service itself knows nothing of faults.
"""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from service.app import create_app, job_limits
from service.commands.serve import bind, keep_pauses_short, server_of
from service.query_client import Frame, QueryClient
from service.settings import ServiceSettings
from service.store.files import DataDirectory
from service.store.jobs import JobStore
from service.store.lifts import LiftStore, TradeoffStore
from service.store.store import Store
from service.supervisor import CHILD, JobProcess, Supervisor

from .conftest import order, stand_in

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

# Name -> class, method, and whether the process dies before or after it.
POINTS: dict[str, tuple[type, str, str]] = {
    "before the job is in line": (JobStore, "submit", "before"),
    "after the job is in line, before the 202": (JobStore, "submit", "after"),
    "after the claim": (JobStore, "claim", "after"),
    "after the child has begun": (JobProcess, "__init__", "after"),
    "after some progress": (JobStore, "advance", "after"),
    "before the lift is published": (DataDirectory, "publish", "before"),
    "after the lift is published, before it has a row": (DataDirectory, "publish", "after"),
    "after the lift has its row": (LiftStore, "finish", "after"),
    "before the trade-off has its row": (TradeoffStore, "finish", "before"),
    "after the trade-off has its row": (TradeoffStore, "finish", "after"),
    "before the work is forgotten": (DataDirectory, "forget_work", "before"),
}


ANSWER_BYTES = 32 << 20  # scores of eight million splats


class NoQueries:
    """Stands in for the query worker, which takes seconds to start and has no part in this."""

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def on_call_finished(self, callback: object) -> None: ...

    def require_device(self, device: str) -> None: ...

    def alive(self) -> bool:
        return True

    def revive(self) -> bool:
        return True

    def call(self, request: dict[str, Any], waiter: Any) -> Frame:
        """An answer as of a large lift."""
        with Path(request["draft"]).open("wb") as draft:
            draft.truncate(ANSWER_BYTES)
        return Frame({})

    restarts = 0


@contextmanager
def standing_in(store: Store, behaviour: str, **settings: Any) -> Iterator[tuple[TestClient, dict[str, Any]]]:
    """The application in this process with stand-ins for jobs and queries, and the body of an order that it takes."""
    from fastapi.testclient import TestClient  # which the server of the other tests has no use for

    options = ServiceSettings.model_validate({"data": store.files.root, "disk_floor_bytes": 0, **settings})
    runner = Supervisor(store, job_limits(options), command=stand_in(behaviour))
    job = order(store)
    body = {"splats": job.splats, "cameras": job.cameras, "features": list(job.features)}
    app = create_app(options, store, runner, cast("QueryClient", NoQueries()))
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client, body


def arm(point: str) -> None:
    """Make this process kill itself when it comes to the point."""
    owner, name, moment = POINTS[point]
    method: Callable[..., Any] = getattr(owner, name)

    def deadly(*arguments: Any, **keywords: Any) -> Any:
        result = method(*arguments, **keywords) if moment == "after" else None
        if moment == "before" or result is not None or name != "claim":  # an empty line is no claim
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, deadly)


def main() -> None:
    """Serve."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--behaviour", default="")
    parser.add_argument("--point", choices=POINTS)
    options = parser.parse_args()
    overrides = {"data": options.data, "checkpoint_seconds": 0.0, "garbage_grace_seconds": 0.0}
    settings = ServiceSettings.model_validate(overrides)
    store = Store.open(settings.data)
    if options.point:
        arm(options.point)
    command = stand_in(options.behaviour) if options.behaviour else CHILD
    runner = Supervisor(store, job_limits(settings), command=command)
    app = create_app(settings, store, runner, cast("QueryClient", NoQueries()))
    listener = bind("127.0.0.1", 0)
    keep_pauses_short()
    server_of(app, settings).run(sockets=[listener])
    store.close()


if __name__ == "__main__":
    main()
