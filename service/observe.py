"""Request ids, the log, the metrics and the version information of the service."""

from __future__ import annotations

import json
import logging
import logging.handlers
import platform
import queue
import re
import secrets
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

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

from liftcore import __version__
from service import models
from service.models import JobState
from service.query_client import QueryClient
from service.store.database import VERSION
from service.store.store import Store

if TYPE_CHECKING:
    from service.content import EventStreams

# Ids of requests

REQUEST_ID = b"x-request-id"
SANE = re.compile(rb"[A-Za-z0-9._~+/=:@-]{1,128}")  # no space, quote or control character: safe in any log
_CURRENT: ContextVar[str | None] = ContextVar("request_id", default=None)


def chosen_id(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the id of a request with these headers (names in lower case): the client's own if it is well-formed."""
    values = [value for name, value in headers if name == REQUEST_ID]
    if len(values) == 1 and SANE.fullmatch(values[0]):
        return values[0].decode("ascii")
    return secrets.token_hex(16)


def current_id() -> str | None:
    """Return the id of the request that this task or thread works for; None if there is none."""
    return _CURRENT.get()


@contextmanager
def working_for(request: str | None) -> Iterator[None]:
    """Set the current request for the block and for threads that it awaits."""
    token = _CURRENT.set(request)
    try:
        yield
    finally:
        _CURRENT.reset(token)


# The log

SECRET = re.compile(r"(?i)\b(bearer|basic)\s+[^\s\"',;]+")
WAITING_RECORDS = 10_000  # for a slow reader of stderr; more records are dropped and counted
SAME_A_MINUTE = 60  # records from one line of code, access log excepted: an error in a loop must not fill the disk

log = logging.getLogger(__name__)
access = logging.getLogger("service.access")


@contextmanager
def logging_to_stderr(log_format: str) -> Iterator[None]:
    """Send the records of this process to stderr while the block runs, with warnings and exceptions of threads.

    A thread of its own writes them: a stalled stderr then blocks no request.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else TextLines())
    waiting: queue.Queue[logging.LogRecord] = queue.Queue(WAITING_RECORDS)
    line = _Line(waiting)
    line.addFilter(LogRateLimit())
    listener = logging.handlers.QueueListener(waiting, handler)
    logging.basicConfig(level=logging.INFO, handlers=[line])
    logging.captureWarnings(True)
    threading.excepthook = _thread_died
    listener.start()
    try:
        yield
    finally:
        listener.stop()


class _Line(logging.handlers.QueueHandler):
    """Add the current request to a record; the thread that writes it works for none."""

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Return the record itself, with its request."""
        record.request_id = current_id()
        return record

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Ignore the error: the queue is full, and a message would go to the same queue."""


class LogRateLimit(logging.Filter):
    """Limit each line of code to SAME_A_MINUTE records a minute; the access log is not limited.

    Args:
        clock: seconds that never go back.
    """

    def __init__(self, clock: Any = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._counts: dict[tuple[str, int], tuple[float, int]] = {}  # place -> start of the minute, records in it

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the record is to be written; the first one after a silence has the number left out."""
        if record.name == access.name:
            return True
        place, now = (record.pathname, record.lineno), self._clock()
        start, count = self._counts.get(place, (now, 0))
        if now - start >= 60:
            left_out = count - SAME_A_MINUTE
            if left_out > 0:
                record.fields = getattr(record, "fields", {}) | {"left_out": left_out}
            start, count = now, 0
        self._counts[place] = start, count + 1
        return count < SAME_A_MINUTE


class JsonLines(logging.Formatter):
    """Format a record as a JSON object: ``time``, ``level``, ``logger``, ``message``, then the record's own fields.

    A record brings ``request_id`` when it is made for a request, ``error`` with an exception's trace, and whatever it
    was given as ``extra={"fields": {...}}``.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        return json.dumps(_fields_of(self, record), ensure_ascii=True, default=str)


class TextLines(logging.Formatter):
    """Format a record for people: time, level, logger and message, other fields as ``name=value``, then the trace."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line, and those of the trace."""
        fields = _fields_of(self, record)
        trace = fields.pop("error", None)
        time, level, logger, message = (fields.pop(name) for name in ("time", "level", "logger", "message"))
        message = message if message.isprintable() else message.encode("unicode_escape").decode()
        rest = "".join(f" {name}={json.dumps(value, default=str)}" for name, value in fields.items())
        line = f"{time} {level.upper()} {logger}: {message}{rest}"
        return line if trace is None else f"{line}\n{trace}"


def _fields_of(formatter: logging.Formatter, record: logging.LogRecord) -> dict[str, Any]:
    moment = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
    fields: dict[str, Any] = {
        "time": moment.replace("+00:00", "Z"),
        "level": record.levelname.lower(),
        "logger": record.name,
        "message": _without_secrets(record.getMessage()),
    }
    request = getattr(record, "request_id", None) or current_id()
    if request is not None:
        fields["request_id"] = request
    fields |= getattr(record, "fields", {})
    if record.exc_info:
        fields["error"] = _without_secrets(formatter.formatException(record.exc_info))
    return fields


def _without_secrets(text: str) -> str:
    """Return a text without secrets. Records quote no headers; traces may."""
    return SECRET.sub(r"\1 [hidden]", text)


def _thread_died(failure: threading.ExceptHookArgs) -> None:
    name = failure.thread.name if failure.thread is not None else "a thread"
    trace = (failure.exc_type, failure.exc_value or failure.exc_type(), failure.exc_traceback)
    log.error("%s died", name, exc_info=trace)


# Version information

API = "1"  # of the routes and their JSON: changes when a client that works today would break
PACKAGES = ("torch", "numpy", "numba", "fastapi", "uvicorn")


def versions(commit: str | None) -> models.Version:
    """Return the versions of this service and of its packages, without importing them; `commit` is a setting."""
    packages = {name: _installed(name) for name in PACKAGES}
    return models.Version(
        version=__version__,
        api=API,
        database=VERSION,
        commit=commit,
        python=platform.python_version(),
        packages={name: number for name, number in packages.items() if number is not None},
    )


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# Counters

# Labels have few values: a route is its template, a method one of HTTP's; all others are `OTHER`.
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "CONNECT"})
OTHER = "other"
REQUEST_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0, 600.0)  # seconds
ATTEMPT_BUCKETS = (1.0, 3.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 10_800.0, 43_200.0)  # seconds


class Metrics:
    """Metrics for Prometheus, in a registry of their own. Any thread may call any method."""

    def __init__(self, store: Store, queries: QueryClient, streams: EventStreams, build: models.Version) -> None:
        disable_created_metrics()  # skip the extra series with creation times
        self._registry = registry = CollectorRegistry()
        self._requests = Counter(
            "splatlift_http_requests", "Requests by route and status.", ("method", "route", "status"),
            registry=registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "splatlift_http_request_seconds", "Time from a request's head to the end of its answer.",
            ("method", "route"), buckets=REQUEST_BUCKETS, registry=registry,
        )  # fmt: skip
        self._received_bytes = Counter(
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
        labels = {"version": build.version, "commit": build.commit or "", "python": build.python, **build.packages}
        Info("splatlift_build", "What runs here.", registry=registry).info(labels)
        ProcessCollector(registry=registry)
        registry.register(_Gauges(store, queries, streams))

    def count_request(
        self, method: str, route: str | None, status: int, *, seconds: float, received_bytes: int
    ) -> None:
        """Count a request. The route is its template; None if no route matches the path."""
        method, route = method if method in METHODS else OTHER, route or OTHER
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)
        if received_bytes:
            self._received_bytes.labels(method, route).inc(received_bytes)

    def attempted(self, outcome: str, seconds: float) -> None:
        """Count an attempt at a job."""
        self._attempts.labels(outcome).observe(seconds)

    def queried(self, operation: str, outcome: str, seconds: float) -> None:
        """Count a call of the query worker."""
        self._queries.labels(operation, outcome).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics in the text format 0.0.4. Reads the database and the disk."""
        return generate_latest(self._registry)


class _Gauges(Collector):
    """Metrics that are read at each scrape."""

    def __init__(self, store: Store, queries: QueryClient, streams: EventStreams) -> None:
        self._store = store
        self._queries = queries
        self._streams = streams

    def describe(self) -> Iterable[Metric]:
        """Return nothing: the names are unique, and collecting here would read the database."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield the current values."""
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
        yield GaugeMetricFamily("splatlift_query_worker_up", "1 while it lives.", value=float(self._queries.alive()))
        yield CounterMetricFamily(
            "splatlift_query_worker_restarts", "Query workers after the first.", value=self._queries.restarts
        )
