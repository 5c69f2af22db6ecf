"""What can go wrong around the numerical core: errors of the HTTP service, in the project's one error tree.

SplatliftError
└── ServiceError
    ├── Unauthorized, MissingScope, ForeignOrigin, Misdirected      who may ask
    ├── InvalidRequest, UnreadableBody, DigestMismatch, UnsupportedEncoding,
    │   UnsupportedMedia, TooLarge, RangeNotSatisfiable, KeyReused
    ├── InUse, Conflict, Changed                                             what the state of things does not allow
    ├── OverQuota, OverLimit, NoSpace                               what there is no room for
    ├── RetryLater: TooMany, Busy (NotReady)                        what may go well in a while
    ├── TimedOut, ClientLeft, Crashed                               what ended without an answer
    └── Misconfigured (StaleDatabase)                               at the start only

Those of liftcore have their statuses and titles in `service.problems`.
"""

from __future__ import annotations

from collections.abc import Mapping

from liftcore.errors import SplatliftError


class ServiceError(SplatliftError):
    """An error of the service around the core; ``headers`` are what an answer tells beside the problem."""

    kind, status, title = "service", 422, "The input is not usable"

    def __init__(
        self, argument: str, *, expected: str, got: str, hint: str = "", headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.headers = dict(headers or {})


class Unauthorized(ServiceError):
    """No key, or one that is not valid (any more)."""

    kind, status, title = "unauthorized", 401, "A key is needed"


class MissingScope(ServiceError):
    """A key that was not made for this."""

    kind, status, title = "missing-scope", 403, "The key may not do that"


class ForeignOrigin(ServiceError):
    """A web page of another site asks in its visitor's name."""

    kind, status, title = "foreign-origin", 403, "Pages of other sites may not do that"


class Misdirected(ServiceError):
    """A Host header that does not mean this service."""

    kind, status, title = "misdirected", 421, "This is another host"


class OverQuota(ServiceError):
    """More bytes than a key may store."""

    kind, status, title = "over-quota", 403, "The key's quota is used up"


class InvalidRequest(ServiceError):
    """A parameter or a body that the route does not understand."""

    kind, status, title = "invalid-request", 422, "The request is malformed"


class UnreadableBody(ServiceError):
    """A body that cannot be parsed as JSON."""

    kind, status, title = "malformed-request", 400, "The request is malformed"


class DigestMismatch(ServiceError):
    """The body's sha256 is not the promised one."""

    kind, status, title = "digest-mismatch", 422, "The body is not what its digest promised"


class UnsupportedEncoding(ServiceError):
    """A body that is compressed."""

    kind, status, title = "unsupported-encoding", 415, "The content encoding is not supported"


class UnsupportedMedia(ServiceError):
    """A body of a media type that the route does not take."""

    kind, status, title = "unsupported-media-type", 415, "The media type is not supported"


class TooLarge(ServiceError):
    """More bytes than the operator allows."""

    kind, status, title = "too-large", 413, "The body is too large"


class RangeNotSatisfiable(ServiceError):
    """A Range header that asks beyond the end."""

    kind, status, title = "range-not-satisfiable", 416, "The range is beyond the end"


class InUse(ServiceError):
    """An asset that a job or a lift still needs."""

    kind, status, title = "in-use", 409, "The asset is in use"


class Conflict(ServiceError):
    """What is in a state that does not allow what was asked."""

    kind, status, title = "conflict", 409, "Its state does not allow that"


class Changed(ServiceError):
    """What is to be changed has another version than its ETag was of."""

    kind, status, title = "changed", 412, "It was changed meanwhile"


class KeyReused(ServiceError):
    """An Idempotency-Key that came with another order before."""

    kind, status, title = "key-reused", 422, "The key belongs to another order"


class OverLimit(ServiceError):
    """A job that needs more time or memory than the operator allows."""

    kind, status, title = "over-limit", 422, "The job needs more than the server allows"


class NoSpace(ServiceError):
    """Less free disk than the operator wants to keep."""

    kind, status, title = "no-space", 507, "There is no room left"


class RetryLater(ServiceError):
    """What may go well in a while."""

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", retry_after: int = 2) -> None:
        headers = {"Retry-After": str(retry_after)}  # seconds
        super().__init__(argument, expected=expected, got=got, hint=hint, headers=headers)


class TooMany(RetryLater):
    """More jobs in line, or uploads, queries or streams at a time, than a key may have."""

    kind, status, title = "too-many", 429, "The key asks for too much at a time"


class Busy(RetryLater):
    """The service has as much waiting work as it accepts."""

    kind, status, title = "busy", 503, "The server is busy"


class NotReady(Busy):
    """The service cannot work now: it stops, or a check failed."""

    kind, status, title = "not-ready", 503, "The server is not ready"


class TimedOut(ServiceError):
    """A query that took longer than the operator allows."""

    kind, status, title = "timed-out", 504, "The query took too long"


class ClientLeft(ServiceError):
    """A client that did not wait for its turn: nobody reads the answer."""

    kind, status, title = "client-left", 400, "The client left"


class Crashed(ServiceError):
    """A process of the service died without an answer."""

    kind, status, title = "crashed", 500, "A process of the server died"


class Misconfigured(ServiceError):
    """Settings or a data directory with which the service does not start."""

    kind = "misconfigured"


class StaleDatabase(Misconfigured):
    """A data directory whose database is gone or older than its files: over it they would be garbage."""

    def __init__(self, data: object, got: str) -> None:
        super().__init__(
            "data", expected="the database that the files beside it were stored with", got=f"{got} in {data}",
            hint="put its newest backup there, with the -wal file if it has one; or make one of the files with"
            f" splatlift store rebuild --data {data}; or begin anew with splatlift serve --new, which moves the files"
            " to quarantine",
        )  # fmt: skip


def require_share(what: str, count: int, most: int | None) -> None:
    """See that a key may have another one of these at the same time; None = as many as it likes.

    Raises:
        TooMany: it has as many as it may.
    """
    if most is not None and count >= most:
        raise TooMany(
            what, expected=f"at most {most} of this key at a time", got="more", hint="wait for the end of one"
        )
