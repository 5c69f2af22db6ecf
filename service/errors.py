"""Errors of the HTTP service, in the project's one tree of errors.

SplatliftError
└── ServiceError
    ├── Unauthorized, MissingScope, ForeignOrigin, Misdirected                  authorization
    ├── InvalidRequest, UnreadableBody, DigestMismatch, UnsupportedEncoding,
    │   UnsupportedMedia, TooLarge, RangeNotSatisfiable, KeyReused              the form of the request
    ├── InUse, Conflict, VersionMismatch                                        the state of the resource
    ├── OverQuota, OverLimit, NoSpace                                           limits of size and time
    ├── RetryLater: KeyLimitReached, ServiceUnavailable (NotReady)              failures that may pass
    ├── TimedOut, ClientDisconnected, ProcessDied                               requests that ended without an answer
    └── Misconfigured (StaleDatabase)                                           raised at the start only

Those of liftcore have their statuses and titles in `service.problems`.
"""

from __future__ import annotations

from collections.abc import Mapping

from liftcore.errors import SplatliftError


class ServiceError(SplatliftError):
    """An error of the service; ``headers`` go into the answer beside the problem."""

    kind, status, title = "service", 422, "The input is not usable"

    def __init__(
        self, argument: str, *, expected: str, got: str, hint: str = "", headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.headers = dict(headers or {})


class Unauthorized(ServiceError):
    """No key, or a key that is not valid."""

    kind, status, title = "unauthorized", 401, "A key is needed"


class MissingScope(ServiceError):
    """A key without the scope that is needed."""

    kind, status, title = "missing-scope", 403, "The key may not do that"


class ForeignOrigin(ServiceError):
    """A web page of another site sends the request."""

    kind, status, title = "foreign-origin", 403, "Pages of other sites may not do that"


class Misdirected(ServiceError):
    """A Host header with a name that is not this service's."""

    kind, status, title = "misdirected", 421, "This is another host"


class OverQuota(ServiceError):
    """More bytes than a key may store."""

    kind, status, title = "over-quota", 403, "The key's quota is used up"


class InvalidRequest(ServiceError):
    """A parameter or a body that the route does not accept."""

    kind, status, title = "invalid-request", 422, "The request is malformed"


class UnreadableBody(ServiceError):
    """A body that cannot be parsed as JSON."""

    kind, status, title = "malformed-request", 400, "The request is malformed"


class DigestMismatch(ServiceError):
    """The sha256 of the body differs from the declared one."""

    kind, status, title = "digest-mismatch", 422, "The body is not what its digest promised"


class UnsupportedEncoding(ServiceError):
    """A compressed body."""

    kind, status, title = "unsupported-encoding", 415, "The content encoding is not supported"


class UnsupportedMedia(ServiceError):
    """A body of a media type that the route does not accept."""

    kind, status, title = "unsupported-media-type", 415, "The media type is not supported"


class TooLarge(ServiceError):
    """More bytes than the operator allows."""

    kind, status, title = "too-large", 413, "The body is too large"


class RangeNotSatisfiable(ServiceError):
    """A Range header that begins beyond the end."""

    kind, status, title = "range-not-satisfiable", 416, "The range is beyond the end"


class InUse(ServiceError):
    """An asset that a job or a lift still needs."""

    kind, status, title = "in-use", 409, "The asset is in use"


class Conflict(ServiceError):
    """The state of the resource does not allow the operation."""

    kind, status, title = "conflict", 409, "Its state does not allow that"


class VersionMismatch(ServiceError):
    """The resource has another version than the one in If-Match."""

    kind, status, title = "changed", 412, "It was changed meanwhile"


class KeyReused(ServiceError):
    """An Idempotency-Key that was used with another order."""

    kind, status, title = "key-reused", 422, "The key belongs to another order"


class OverLimit(ServiceError):
    """A job that needs more time or memory than the operator allows."""

    kind, status, title = "over-limit", 422, "The job needs more than the server allows"


class NoSpace(ServiceError):
    """Less free disk than the operator reserves."""

    kind, status, title = "no-space", 507, "There is no space left"


class RetryLater(ServiceError):
    """A failure that may pass: the client may retry."""

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", retry_after: int = 2) -> None:
        headers = {"Retry-After": str(retry_after)}  # seconds
        super().__init__(argument, expected=expected, got=got, hint=hint, headers=headers)


class KeyLimitReached(RetryLater):
    """A key has as many jobs, uploads, queries or streams as it may have at a time."""

    kind, status, title = "too-many", 429, "The key asks for too much at a time"


class ServiceUnavailable(RetryLater):
    """The service accepts no more work at the moment."""

    kind, status, title = "busy", 503, "The server is busy"


class NotReady(ServiceUnavailable):
    """The service is not ready: it stops, or a check failed."""

    kind, status, title = "not-ready", 503, "The server is not ready"


class TimedOut(ServiceError):
    """A query that took longer than the operator allows."""

    kind, status, title = "timed-out", 504, "The query took too long"


class ClientDisconnected(ServiceError):
    """The client disconnected before its answer was computed."""

    kind, status, title = "client-left", 400, "The client left"


class ProcessDied(ServiceError):
    """A process of the service died without an answer."""

    kind, status, title = "crashed", 500, "A process of the server died"


class Misconfigured(ServiceError):
    """Settings or a data directory with which the service cannot start."""

    kind = "misconfigured"


class StaleDatabase(Misconfigured):
    """A data directory whose database is missing or older than its files: a new one would treat them as garbage."""

    def __init__(self, data: object, got: str) -> None:
        super().__init__(
            "data", expected="the database that the files beside it were stored with", got=f"{got} in {data}",
            hint="put its newest backup there, with the -wal file if it has one; or make one of the files with"
            f" splatlift store rebuild --data {data}; or begin anew with splatlift serve --new, which moves the files"
            " to quarantine",
        )  # fmt: skip


def require_share(argument: str, count: int, limit: int | None) -> None:
    """Require that a key is below its limit of such requests at a time; None means no limit.

    Raises:
        KeyLimitReached: it has as many as it may.
    """
    if limit is not None and count >= limit:
        raise KeyLimitReached(
            argument, expected=f"at most {limit} of this key at a time", got="more", hint="wait for the end of one"
        )
