"""What can go wrong around the numerical core: errors of the HTTP service, in the project's one error tree.

SplatliftError
└── ServiceError
    ├── Unauthorized         no key, or one that is not valid                  401 + WWW-Authenticate
    ├── MissingScope         a key that may not do that                        403 + WWW-Authenticate
    ├── ForeignOrigin        a web page of another site asks                   403
    ├── Misdirected          a Host that is not this service                   421
    ├── OverQuota            more bytes than the key may store                 403
    ├── TooMany              more jobs in line or uploads than the key may     429 + Retry-After
    ├── InvalidRequest       a parameter or a body that no route understands   422
    ├── DigestMismatch       the body is not what ?sha256= promised            422
    ├── InvalidEncoding      a compressed body that does not decompress        422
    ├── UnsupportedEncoding  a Content-Encoding that is neither gzip nor zstd  415
    ├── TooLarge             more bytes than the operator allows               413
    ├── RangeNotSatisfiable  a Range beyond the end of the content             416
    ├── InUse                an asset that a job or a lift needs               409
    ├── Conflict             a job whose state does not allow that             409
    ├── KeyReused            an Idempotency-Key that came with another order   422
    ├── OverLimit            a job beyond the operator's time or memory        422
    ├── NoSpace              less free disk than the operator wants to keep    507
    ├── Busy                 too many queries or jobs are waiting              503 + Retry-After
    ├── NotReady             a check of /readyz that failed                    503 + Retry-After
    ├── TimedOut             a query that took longer than the operator allows 504
    ├── Crashed              a process of ours died without an answer          500
    └── Misconfigured        the operator's settings or data directory         (start-up only)
        └── StaleDatabase    files whose database is gone, or an older one     (start-up only)
"""

from __future__ import annotations

from liftcore.errors import SplatliftError


class ServiceError(SplatliftError):
    """An error of the service around the core."""

    kind = "service"


class Unauthorized(ServiceError):
    """No key, or one that is not valid (any more)."""

    kind = "unauthorized"


class MissingScope(ServiceError):
    """A key that was not made for this."""

    kind = "missing-scope"

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", scope: str = "") -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.scope = scope  # the one that it lacks, told in WWW-Authenticate


class ForeignOrigin(ServiceError):
    """A web page of another site asks in its visitor's name."""

    kind = "foreign-origin"


class Misdirected(ServiceError):
    """A Host header that does not mean this service."""

    kind = "misdirected"


class OverQuota(ServiceError):
    """More bytes than a key may store."""

    kind = "over-quota"


class TooMany(ServiceError):
    """More jobs in line, or uploads at a time, than a key may have."""

    kind = "too-many"

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", retry_after: int = 2) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.retry_after = retry_after  # seconds, told in Retry-After


class InvalidRequest(ServiceError):
    """A parameter or a body that the route does not understand."""

    kind = "invalid-request"


class DigestMismatch(ServiceError):
    """The body's sha256 is not the promised one."""

    kind = "digest-mismatch"


class InvalidEncoding(ServiceError):
    """A compressed body that does not decompress."""

    kind = "invalid-encoding"


class UnsupportedEncoding(ServiceError):
    """A Content-Encoding that the service does not read."""

    kind = "unsupported-encoding"


class TooLarge(ServiceError):
    """More bytes than the operator allows."""

    kind = "too-large"


class RangeNotSatisfiable(ServiceError):
    """A Range header that asks beyond the end."""

    kind = "range-not-satisfiable"

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", size: int = 0) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.size = size  # bytes of the content, told in Content-Range


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


class Busy(ServiceError):
    """The service has as much waiting work as it accepts."""

    kind = "busy"

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", retry_after: int = 2) -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.retry_after = retry_after  # seconds, told in Retry-After


class NotReady(Busy):
    """The service cannot work now: it stops, or a check failed."""

    kind = "not-ready"


class TimedOut(ServiceError):
    """A query that took longer than the operator allows."""

    kind = "timed-out"


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
