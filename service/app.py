"""Wiring: the parts, the layers, the routes. There is no global application."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI

from liftcore import __version__
from liftcore.files import PhotoIndexes
from service import problems
from service.auth import STRANGER, Gate
from service.content import EventStreams
from service.errand import revive
from service.jobs.supervisor import JobLimits, Supervisor
from service.middleware import AnswerHead, RecordedApp, Turns
from service.observe import Metrics, versions
from service.queries.client import QueryClient, QueryLimits
from service.requests import KnownParameters
from service.routes import assets, jobs, lifts, operations, queries, selections
from service.settings import ServiceSettings
from service.state import AppState, Readiness, Stopping
from service.store.store import Collector, Store


def create_app(settings: ServiceSettings, store: Store, runner: Supervisor, worker: QueryClient) -> FastAPI:
    """The application. It starts and stops the runner and the worker; the store is its caller's to close."""

    threads = anyio.CapacityLimiter
    streams, build = EventStreams(settings.max_streams, settings.key_streams), versions(settings.commit)
    stopping = Stopping(streams, runner, notice_seconds=settings.notice_seconds)
    metrics = Metrics(store, worker, streams, build)
    readiness = Readiness(store, runner, worker, stopping)
    runner.on_attempt_finished(metrics.attempted)
    worker.on_call_finished(metrics.queried)
    collector = Collector(store, settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.deps = deps = AppState(
            settings=settings, version=build, store=store, caller=STRANGER,
            runner=runner, queries=worker,
            streams=streams, photos=PhotoIndexes(), metrics=metrics, readiness=readiness,
            checks=threads(settings.parallel_checks),  # uploads that are validated at the same time
            planning=threads(1),  # plans, for which no upload waits
            writing=threads(8),  # uploads: a stalled disk stops them, and no other route
            parsing=threads(2),  # JSON bodies
            ordering=threads(2),  # orders, which are compared with all names in their assets: these take memory
            scrapes=threads(1),  # the metrics
        )  # fmt: skip
        await anyio.to_thread.run_sync(revive)
        await anyio.to_thread.run_sync(worker.start)
        await anyio.to_thread.run_sync(runner.start)
        collector.start()
        try:
            yield
        finally:
            deps.ending.set()
            streams.close()
            for part in (collector, runner, worker):
                await anyio.to_thread.run_sync(part.stop)

    app = RecordedApp(
        title="splatlift",
        version=__version__,
        description="Lift 2D features onto trained splat scenes and query them in words.",
        lifespan=lifespan,
        responses=problems.RESPONSES,
        openapi_url=None,  # `service.routes.operations` tells it, and of keys, beside the event loop
        redirect_slashes=False,
    )
    app.state.stopping, app.state.metrics, app.state.documents = stopping, metrics, operations.Documents(app)
    app.add_middleware(AnswerHead)
    app.add_middleware(Gate, keys=store.keys, settings=settings, stopping=lambda: stopping.begun)
    app.add_middleware(Turns)
    problems.install(app)
    app.include_router(operations.router)  # probes and links to the page may carry what they like
    for module in (assets, jobs, lifts, queries, selections):
        app.include_router(module.router, dependencies=[KnownParameters])
    return app


def assemble(settings: ServiceSettings, store: Store) -> FastAPI:
    """The application with the usual runner and query worker."""
    return create_app(settings, store, Supervisor(store, job_limits(settings)), QueryClient(query_limits(settings)))


def query_limits(settings: ServiceSettings) -> QueryLimits:
    """What the settings allow queries."""
    return QueryLimits(
        waiting=settings.query_waiting,
        seconds=settings.query_seconds,
        scenes=settings.query_scenes,
        cache_bytes=settings.query_cache_bytes,
        encoder=settings.encoder,
        of_a_key=settings.key_queries,
    )


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
        engine=settings.engine,
        ray_address=settings.ray_address,
    )
