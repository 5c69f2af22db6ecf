"""What the service counts, for Prometheus. Each application has a registry of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Histogram,
    Info,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from service.jobs.streams import EventStreams
from service.queries.warm import WarmWorker
from service.store.store import Store
from service.wire import JobState, Version

# A label may take few values: a route is its template, a method one that HTTP defines, and the rest are one value.
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "CONNECT"})
OTHER = "other"
REQUEST_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0, 600.0)  # seconds
ATTEMPT_BUCKETS = (1.0, 3.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 10_800.0, 43_200.0)  # seconds


@dataclass(frozen=True)
class Served:
    """A request that was answered, or given up."""

    method: str
    route: str | None  # the template, None when no route takes the path
    status: int  # 0 when there was no answer
    seconds: float
    received: int  # bytes of the body


class Metrics:
    """Counters that are told, and gauges that are looked up when somebody asks. Any thread may call any method."""

    def __init__(self, store: Store, worker: WarmWorker, streams: EventStreams, build: Version) -> None:
        disable_created_metrics()  # a second series for each one that says when it began: nobody reads those
        self._registry = registry = CollectorRegistry()
        self._requests = Counter(
            "splatlift_http_requests", "Requests by route and status.", ("method", "route", "status"),
            registry=registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "splatlift_http_request_seconds", "Time from a request's head to the end of its answer.",
            ("method", "route"), buckets=REQUEST_BUCKETS, registry=registry,
        )  # fmt: skip
        self._received = Counter(
            "splatlift_http_request_body_bytes", "Bytes of request bodies; of PUT /assets/{asset}: uploads.",
            ("method", "route"), registry=registry,
        )  # fmt: skip
        self._attempts = Histogram(
            "splatlift_attempt_seconds", "Time that attempts at jobs took, by the state that the job came to.",
            ("outcome",), buckets=ATTEMPT_BUCKETS, registry=registry,
        )  # fmt: skip
        self._queries = Histogram(
            "splatlift_query_seconds", "Time that the query worker took, waiting included, by what came of it.",
            ("operation", "outcome"), buckets=REQUEST_BUCKETS, registry=registry,
        )  # fmt: skip
        told = {"version": build.version, "commit": build.commit or "", "python": build.python, **build.packages}
        Info("splatlift_build", "What runs here.", registry=registry).info(told)
        ProcessCollector(registry=registry)
        registry.register(_Looked(store, worker, streams))

    def served(self, request: Served) -> None:
        """Count a request."""
        method = request.method if request.method in METHODS else OTHER
        route = request.route or OTHER
        self._requests.labels(method, route, str(request.status)).inc()
        self._seconds.labels(method, route).observe(request.seconds)
        if request.received:
            self._received.labels(method, route).inc(request.received)

    def attempted(self, outcome: str, seconds: float) -> None:
        """Count an attempt at a job."""
        self._attempts.labels(outcome).observe(seconds)

    def queried(self, operation: str, outcome: str, seconds: float) -> None:
        """Count a call of the query worker."""
        self._queries.labels(operation, outcome).observe(seconds)

    def text(self) -> bytes:
        """All of it in the text format 0.0.4. Reads the database and the disk."""
        return generate_latest(self._registry)


class _Looked(Collector):
    """What is true now."""

    def __init__(self, store: Store, worker: WarmWorker, streams: EventStreams) -> None:
        self._store = store
        self._worker = worker
        self._streams = streams

    def describe(self) -> Iterable[Metric]:
        """Nothing: the names are our own, and looking them up would read the database."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """ViewMask."""
        counts = self._store.jobs.count_by_state()
        jobs = GaugeMetricFamily("splatlift_jobs", "Jobs by state.", labels=("state",))
        for state in JobState:
            jobs.add_metric((state.value,), counts.get(state, 0))
        yield jobs
        running = counts.get(JobState.RUNNING, 0) + counts.get(JobState.CANCELING, 0)
        yield GaugeMetricFamily("splatlift_queue_length", "Jobs in line.", value=counts.get(JobState.QUEUED, 0))
        yield GaugeMetricFamily("splatlift_running_lifts", "Jobs whose process is there.", value=running)
        yield GaugeMetricFamily("splatlift_open_streams", "Clients that follow events.", value=self._streams.open)
        files = self._store.files
        yield GaugeMetricFamily("splatlift_disk_free_bytes", "Free disk below the data.", value=files.free_bytes())
        yield GaugeMetricFamily("splatlift_disk_floor_bytes", "Free disk to be left.", value=files.floor_bytes)
        yield GaugeMetricFamily("splatlift_query_worker_up", "1 while it lives.", value=float(self._worker.alive()))
        yield CounterMetricFamily(
            "splatlift_query_worker_restarts", "Query workers after the first.", value=self._worker.restarts
        )
