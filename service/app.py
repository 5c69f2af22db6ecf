"""Wiring: the parts, the routes, the one error table. There is no global application."""

from __future__ import annotations

import os
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI

from liftcore import __version__
from service import problems
from service.head import AnswerHead
from service.jobs.devices import Devices
from service.jobs.limits import JobLimits
from service.jobs.streams import EventStreams
from service.jobs.supervisor import Supervisor
from service.keys.document import describe_keys
from service.keys.gate import Gate
from service.limits import BodyLimit, Pace
from service.metrics import Metrics
from service.parameters import KnownParameters
from service.parts import Parts
from service.queries.warm import QueryLimits, WarmWorker
from service.readiness import Readiness
from service.recorder import RecordedApp
from service.routes import assets, jobs, lifts, operations, queries, reference, tradeoffs
from service.settings import ServiceSettings
from service.stopping import RefuseWork, Stopping
from service.store.garbage import Collector
from service.store.store import Store
from service.versions import versions


def create_app(settings: ServiceSettings, store: Store, runner: Supervisor, worker: WarmWorker) -> FastAPI:
    """The application. It starts and stops the runner and the worker; the store is its caller's to close."""

    streams, devices = EventStreams(settings.max_streams), Devices()
    stopping = Stopping(streams, runner, notice_seconds=settings.notice_seconds)
    readiness = Readiness(store, runner, worker, stopping)
    metrics = Metrics(store, worker, streams, build=versions(settings.commit))
    runner.tell(metrics.attempted)
    worker.tell(metrics.queried)
    collector = Collector(
        store, every_seconds=settings.garbage_seconds, grace_seconds=settings.garbage_grace_seconds,
        quarantine_seconds=settings.quarantine_seconds,
    )  # fmt: skip

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        ending = threading.Event()
        checks, scrapes = anyio.CapacityLimiter(settings.parallel_checks), anyio.CapacityLimiter(1)
        app.state.parts = Parts(
            settings, store, runner, devices, worker, streams, checks, metrics=metrics, scrapes=scrapes,
            readiness=readiness, ending=ending,
        )  # fmt: skip
        await anyio.to_thread.run_sync(worker.start)
        await anyio.to_thread.run_sync(runner.start)
        collector.start()
        try:
            yield
        finally:
            ending.set()
            streams.close()
            await anyio.to_thread.run_sync(collector.stop)
            await anyio.to_thread.run_sync(runner.stop)
            await anyio.to_thread.run_sync(worker.stop)

    app = RecordedApp(
        title="splatlift",
        version=__version__,
        description="Lift 2D features onto trained splat scenes and query them in words.",
        lifespan=lifespan,
        responses=problems.RESPONSES,
        docs_url=None,  # FastAPI's own pages load their scripts from other hosts
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.stopping, app.state.metrics = stopping, metrics
    app.add_middleware(AnswerHead)
    app.add_middleware(BodyLimit, limit=settings.max_body_bytes, pace=pace_of(settings))
    app.add_middleware(RefuseWork, stopping=stopping)
    app.add_middleware(Gate, keys=store.keys, settings=settings)  # outside of it: no body of a stranger is read
    problems.install(app)
    app.include_router(reference.router)
    app.include_router(operations.router)  # probes and links to the page may carry what they like
    for module in (assets, jobs, lifts, tradeoffs, queries):
        app.include_router(module.router, dependencies=[KnownParameters])
    describe_keys(app, store.keys.under(settings.keys))
    return app


def assemble(settings: ServiceSettings, store: Store) -> FastAPI:
    """The application with the usual runner and query worker."""
    runner, worker = Supervisor(store, job_limits(settings)), WarmWorker(query_limits(settings))
    return create_app(settings, store, runner, worker)


def query_limits(settings: ServiceSettings) -> QueryLimits:
    """What the settings allow queries."""
    return QueryLimits(
        waiting=settings.query_waiting,
        seconds=settings.query_seconds,
        scenes=settings.query_scenes,
        cache_bytes=settings.query_cache_bytes,
        encoder=settings.encoder,
    )


def pace_of(settings: ServiceSettings) -> Pace:
    """What the settings ask of clients."""
    return Pace(settings.min_bytes_per_second, settings.slow_grace_seconds, settings.header_seconds)


def job_limits(settings: ServiceSettings) -> JobLimits:
    """What the settings allow a job."""
    cores = len(os.sched_getaffinity(0))
    return JobLimits(
        parallel=settings.parallel_lifts,
        threads=settings.lift_threads or max(1, cores // settings.parallel_lifts),
        seconds=settings.lift_seconds,
        memory_bytes=settings.lift_memory_bytes,
        lease_seconds=settings.lease_seconds,
        checkpoint_seconds=settings.checkpoint_seconds,
    )
