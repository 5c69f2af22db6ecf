"""The parts that routes call, as the application carries them."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Annotated

import anyio
from fastapi import Depends, Request

from service.jobs.devices import Devices
from service.jobs.streams import EventStreams
from service.jobs.supervisor import Supervisor
from service.keys.gate import CALLER
from service.metrics import Metrics
from service.queries.warm import WarmWorker
from service.readiness import Readiness
from service.settings import ServiceSettings
from service.store.store import Store


@dataclass(frozen=True)
class Parts:
    """What `create_app` was given. Routes get the store as their caller sees it."""

    settings: ServiceSettings
    store: Store
    runner: Supervisor
    devices: Devices
    queries: WarmWorker
    streams: EventStreams
    checks: anyio.CapacityLimiter  # uploads that are validated at the same time
    metrics: Metrics
    scrapes: anyio.CapacityLimiter  # those who read the metrics at the same time
    readiness: Readiness
    ending: threading.Event  # set when what still runs must end


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _parts(request: Request) -> Parts:
    parts: Parts = request.app.state.parts
    return replace(parts, store=parts.store.seen_by(request.scope["state"][CALLER].owner))


Here = Annotated[Parts, Depends(_parts)]
