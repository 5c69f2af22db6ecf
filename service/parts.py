"""The parts that routes call, as the application carries them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import anyio
from fastapi import Depends, Request

from service.jobs.streams import EventStreams
from service.jobs.supervisor import Supervisor
from service.queries.warm import WarmWorker
from service.settings import ServiceSettings
from service.store.store import Store


@dataclass(frozen=True)
class Parts:
    """What `create_app` was given."""

    settings: ServiceSettings
    store: Store
    runner: Supervisor
    queries: WarmWorker
    streams: EventStreams
    checks: anyio.CapacityLimiter  # uploads that are validated at the same time


def _parts(request: Request) -> Parts:
    return request.app.state.parts


Here = Annotated[Parts, Depends(_parts)]
