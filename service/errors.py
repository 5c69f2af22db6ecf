"""What can go wrong around the numerical core: errors of the HTTP service, in the project's one error tree.

SplatliftError
└── ServiceError
    ├── Unauthorized, MissingScope, ForeignOrigin, Misdirected      who may ask
    ├── InvalidRequest, UnreadableBody, DigestMismatch, UnsupportedEncoding, TooLarge,
    │   RangeNotSatisfiable, KeyReused
    ├── InUse, Conflict                                             what the state of things does not allow
    ├── OverQuota, OverLimit, NoSpace                               what there is no room for
    ├── RetryLater: TooMany, Busy (NotReady)                        what may go well in a while
    ├── TimedOut, ClientLeft, Crashed                               what ended without an answer
    └── Misconfigured (StaleDatabase)                               at the start only

Statuses and titles are in `service.problems`, which no child process loads.
"""

from __future__ import annotations

from collections.abc import Mapping

from liftcore.errors import SplatliftError


class ServiceError(SplatliftError):
    """An error of the service around the core; ``headers`` are what an answer tells beside the problem."""

    kind = "service"

    def __init__(
        self, argument: str, *, expected: str, got: str, hint: str = "", headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.headers = dict(headers or {})


class Unauthorized(ServiceError):
    """No key, or one that is not valid (any more)."""

    kind = "unauthorized"


class MissingScope(ServiceError):
    """A key that was not made for this."""

    kind = "missing-scope"


class ForeignOrigin(ServiceError):
    """A web page of another site asks in its visitor's name."""

    kind = "foreign-origin"


class Misdirected(ServiceError):
    """A Host header that does not mean this service."""

    kind = "misdirected"


class OverQuota(ServiceError):
    """More bytes than a key may store."""

    kind = "over-quota"


class InvalidRequest(ServiceError):
    """A parameter or a body that the route does not understand."""

    kind = "invalid-request"


class UnreadableBody(ServiceError):
    """A body that no reader of JSON gets to the end of."""

    kind = "malformed-request"


class DigestMismatch(ServiceError):
    """The body's sha256 is not the promised one."""

    kind = "digest-mismatch"


class UnsupportedEncoding(ServiceError):
    """A body that is compressed."""

    kind = "unsupported-encoding"


class TooLarge(ServiceError):
    """More bytes than the operator allows."""

    kind = "too-large"


class RangeNotSatisfiable(ServiceError):
    """A Range header that asks beyond the end."""

    kind = "range-not-satisfiable"


class InUse(ServiceError):
    """An asset that a job or a lift still needs."""

    kind = "in-use"


class Conflict(ServiceError):
    """A job whose state does not allow what was asked."""

    kind = "conflict"


class KeyReused(ServiceError):
    """An Idempotency-Key that came with another order before."""

    kind = "key-reused"


class OverLimit(ServiceError):
    """A job that needs more time or memory than the operator allows."""

    kind = "over-limit"


class NoSpace(ServiceError):
    """Less free disk than the operator wants to keep."""

    kind = "no-space"


class RetryLater(ServiceError):
    """What may go well in a while."""

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", retry_after: int = 2) -> None:
        headers = {"Retry-After": str(retry_after)}  # seconds
        super().__init__(argument, expected=expected, got=got, hint=hint, headers=headers)


class TooMany(RetryLater):
    """More jobs in line, or uploads, queries or streams at a time, than a key may have."""

    kind = "too-many"


class Busy(RetryLater):
    """The service has as much waiting work as it accepts."""

    kind = "busy"


class NotReady(Busy):
    """The service cannot work now: it stops, or a check failed."""

    kind = "not-ready"


class TimedOut(ServiceError):
    """A query that took longer than the operator allows."""

    kind = "timed-out"


class ClientLeft(ServiceError):
    """A client that did not wait for its turn: nobody reads the answer."""

    kind = "client-left"


class Crashed(ServiceError):
    """A process of the service died without an answer."""

    kind = "crashed"


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
