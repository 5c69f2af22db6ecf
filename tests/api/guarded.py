"""An application with keys, and one thing of each kind that belongs to Alice. No process runs behind it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.routing import Route

from service.app import create_app
from service.models import JobKind
from service.query_client import QueryClient
from service.settings import ServiceSettings
from service.store.jobs import JobOrder
from service.store.keys import Quota
from service.store.lifts import FinishedLift, FinishedTradeoff
from service.store.owners import Owner, Scope
from service.store.store import Store
from service.supervisor import Supervisor
from tests.crash.conftest import order
from tests.crash.server import NoQueries
from tests.server import ADDRESS

SCOPES = {"alice": "read write", "bob": "read write", "boss": "admin"}
METADATA = {
    "settings": {}, "timings": {}, "version": "0", "encoder": "e", "text_space": "t",
}  # fmt: skip


class NoJobs(NoQueries):
    """Stands in for the supervisor: jobs stay where the tests put them."""

    def on_attempt_finished(self, callback: object) -> None: ...

    def wake(self) -> None: ...


@dataclass(frozen=True)
class KeyedServer:
    """The application, its store, the secrets by name, and what Alice has."""

    client: TestClient
    store: Store
    secrets: Mapping[str, str]
    ids: Mapping[str, str]  # of keys, by name
    order: JobOrder
    lift_job: str  # a job with a lift
    tradeoff_job: str  # one with a trade-off
    queued: str

    def ask(self, name: str | None, method: str, path: str, **options: Any) -> Any:
        """A request with somebody's key, or without one."""
        headers = options.pop("headers", {}) | ({} if name is None else bearer(self.secrets[name]))
        return self.client.request(method, path, headers=headers, **options)

    def body(self) -> dict[str, Any]:
        """Alice's order, as POST /lift takes it."""
        return {
            "splats": self.order.splats, "cameras": self.order.cameras, "features": list(self.order.features)
        }  # fmt: skip


def bearer(secret: str) -> dict[str, str]:
    """The header that brings a key."""
    return {"Authorization": f"Bearer {secret}"}


@contextmanager
def keyed_server(data: Path, views: Sequence[str] = ("v",), **settings: Any) -> Iterator[KeyedServer]:
    """Serve it; her lift is of these views."""
    store = Store.open(data)
    server_settings = ServiceSettings.model_validate({"data": data, "disk_floor_bytes": 0, **settings})
    app = create_app(server_settings, store, cast("Supervisor", NoJobs()), cast("QueryClient", NoQueries()))
    keys = {name: make_key(store, scopes) for name, scopes in SCOPES.items()}
    ids, secrets = ({name: pair[place] for name, pair in keys.items()} for place in (0, 1))
    alice = Owner(ids["alice"], sees_all=False)
    lift_order = order(store, alice)
    lift_job = store.jobs.submit(alice, lift_order)[0]
    finish(store, b"a lift", views)
    tradeoff_job = store.jobs.submit(alice, replace(lift_order, kind=JobKind.TRADEOFF, parameters={"budget_s": 60}))[
        0
    ]
    finish_tradeoff(store, b"a chart")
    queued = store.jobs.submit(alice, lift_order)[0]
    try:
        with TestClient(app, ADDRESS, raise_server_exceptions=False) as client:
            yield KeyedServer(client, store, secrets, ids, lift_order, lift_job, tradeoff_job, queued)
    finally:
        store.close()


def make_key(store: Store, scopes: str, **quota: int) -> tuple[str, str]:
    """The id and the secret of a new key."""
    key, secret = store.keys.create("somebody", frozenset(map(Scope, scopes.split())), Quota(**quota))
    return key.id, secret


def finish(store: Store, content: bytes, views: Sequence[str] = ("v",)) -> None:
    """Claim the oldest job in line and end it with a lift."""
    diagnostics = {"warnings": ["x"], "views_without_splats": list(views)}
    metadata = {**METADATA, "diagnostics": diagnostics, "views": list(views)}
    attempt = store.jobs.claim()
    assert attempt is not None
    with store.files.draft(".safetensors") as draft:
        draft.write_bytes(content)
        assert store.lifts.finish(attempt.id, attempt.attempt, FinishedLift(draft, "0" * 64, 1, 1, metadata))


def finish_tradeoff(store: Store, chart: bytes) -> None:
    """Claim the oldest job in line and end it with a trade-off."""
    attempt = store.jobs.claim()
    assert attempt is not None
    results = {"runs": [], "over_budget": [], "choice": {}, "views": {}, "budget_s": 60, "seconds": 1}
    assert store.tradeoffs.finish(attempt.id, attempt.attempt, FinishedTradeoff(results, "a table", chart))


def every_route(app: FastAPI) -> list[tuple[str, str]]:
    """Method and path of all that the application answers, documented or not."""
    results: list[tuple[str, str]] = []
    routes = list(app.routes)
    while routes:
        route = routes.pop(0)
        if isinstance(route, Route):
            results += [(method, route.path) for method in sorted(route.methods or ()) if method != "HEAD"]
        else:
            routes += vars(route)["original_router"].routes  # of a router that was included
    return results


def address(path: str, job: str, asset: str) -> str:
    """A route's path with the ids in their places."""
    for name, value in {
        "kind": "cameras",
        "asset": asset,
        "object": "0",
        "selection": "0" * 16,
        "share": "0" * 12,
    }.items():
        path = path.replace(f"{{{name}}}", value)
    return re.sub(r"\{(job|lift|tradeoff)\}", job, path)
