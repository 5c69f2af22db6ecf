"""What a key may do, and what each request needs."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from service.errors import InvalidRequest


class Scope(StrEnum):
    """A kind of request that a key allows."""

    READ = "read"  # look: assets, jobs, results, queries, pictures
    WRITE = "write"  # upload, order, cancel, delete
    METRICS = "metrics"  # /metrics, which tells of everybody's work together, and nothing else
    ADMIN = "admin"  # all of these, on everybody's things


# Open to everybody: what says nothing of anyone's work. The page asks for a key itself; the API is described to those
# who have none yet, and browsers send none with a link.
OPEN = frozenset(
    {
        "/", "/web/page.js", "/web/page.css", "/web/LICENSES.txt", "/healthz", "/readyz", "/version",
        "/openapi.json", "/docs", "/docs/swagger-ui-bundle.js", "/docs/swagger-ui.css",
    }
)  # fmt: skip
SAFE = frozenset({"GET", "HEAD"})


def needed(method: str, path: str) -> Scope | None:
    """The scope that a request needs, None when it needs no key. What is not listed as open is not."""
    if method in SAFE and path in OPEN:
        return None
    if path == "/metrics":
        return Scope.METRICS
    asks = method == "POST" and (
        path in ("/query", "/render") or path.startswith("/query/")
    )  # a question may have a body
    return Scope.READ if method in SAFE or asks else Scope.WRITE


def allows(scopes: frozenset[Scope], wanted: Scope) -> bool:
    """Whether a key of these scopes may do what needs that one."""
    return wanted in scopes or Scope.ADMIN in scopes


def parse_scopes(names: Iterable[str]) -> frozenset[Scope]:
    """Scopes by their names.

    Raises:
        InvalidRequest: there is none, or one is unknown.
    """
    names = [name.strip() for name in names if name.strip()]
    wrong = next((name for name in names if name not in set(Scope)), None if names else "none")
    if wrong is not None:
        raise InvalidRequest("scopes", expected=f"one or more of {', '.join(Scope)}", got=wrong[:80])
    return frozenset(map(Scope, names))
