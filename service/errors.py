"""What can go wrong around the numerical core: errors of the HTTP service, in the project's one error tree.

SplatliftError
└── ServiceError
    ├── Unauthorized         no key, or one that is not valid                  401 + WWW-Authenticate
    ├── MissingScope         a key that may not do that                        403 + WWW-Authenticate
    ├── ForeignOrigin        a web page of another site asks                   403
    ├── Misdirected          a Host that is not this service                   421
    ├── OverQuota            more bytes than the key may store                 403
    ├── InvalidRequest       a parameter or a body that no route understands   422
    ├── DigestMismatch       the body is not what ?sha256= promised            422
    ├── InvalidEncoding      a compressed body that does not decompress        422
    ├── UnsupportedEncoding  a Content-Encoding that is neither gzip nor zstd  415
    ├── TooLarge             more bytes than the operator allows               413
    ├── RangeNotSatisfiable  a Range beyond the end of the content             416 + Content-Range
    ├── InUse                an asset that a job or a lift needs               409
    ├── Conflict             a job whose state does not allow that             409
    ├── KeyReused            an Idempotency-Key that came with another order   422
    ├── OverLimit            a job beyond the operator's time or memory        422
    ├── NoSpace              less free disk than the operator wants to keep    507
    ├── RetryLater
    │   ├── TooMany          more jobs in line or uploads than the key may     429 + Retry-After
    │   └── Busy             as much work as the service accepts               503 + Retry-After
    │       └── NotReady     a check of /readyz that failed                    503 + Retry-After
    ├── TimedOut             a query that took longer than the operator allows 504
    ├── Crashed              a process of ours died without an answer          500
    └── Misconfigured        the operator's settings or data directory         (start-up only)
        └── StaleDatabase    files whose database is gone, or an older one     (start-up only)

Statuses and titles are in `service.problems`, which no child process loads.
"""

from __future__ import annotations

from liftcore.errors import SplatliftError


class ServiceError(SplatliftError):
    """An error of the service around the core."""

    kind = "service"

    @property
    def headers(self) -> dict[str, str]:
        """What an answer with this error tells beside its problem."""
        return {}


class Unauthorized(ServiceError):
    """No key, or one that is not valid (any more)."""

    kind = "unauthorized"

    @property
    def headers(self) -> dict[str, str]:
        """The scheme, with a code only where a key was sent (RFC 6750, 3.1)."""
        code = ', error="invalid_token"' if self.got != "none" else ""
        return {"WWW-Authenticate": f'Bearer realm="splatlift"{code}'}


class MissingScope(ServiceError):
    """A key that was not made for this."""

    kind = "missing-scope"

    def __init__(self, argument: str, *, expected: str, got: str, hint: str = "", scope: str = "") -> None:
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.scope = scope  # the one that it lacks

    @property
    def headers(self) -> dict[str, str]:
        """The scope that is missing."""
        return {"WWW-Authenticate": f'Bearer realm="splatlift", error="insufficient_scope", scope="{self.scope}"'}


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
        self.size = size  # bytes of the content

    @property
    def headers(self) -> dict[str, str]:
        """The size that there is."""
        return {"Content-Range": f"bytes */{self.size}"}


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
        super().__init__(argument, expected=expected, got=got, hint=hint)
        self.retry_after = retry_after  # seconds

    @property
    def headers(self) -> dict[str, str]:
        """When to ask again."""
        return {"Retry-After": str(self.retry_after)}


class TooMany(RetryLater):
    """More jobs in line, or uploads at a time, than a key may have."""

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
