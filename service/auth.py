"""Authorization of requests: host, origin, key and scope are checked before anything of a request is read.

Host and Origin come first: the threat is a page of another site in the browser of a user who can reach the service.
The page may send requests itself (Origin shows it), or let its own name resolve to this machine (DNS rebinding; Host
shows it). Then follow the key, its scope, a server that stops, and the limit of the key's uploads at a time.
"""

from __future__ import annotations

import ipaddress
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import anyio
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from service.errors import (
    ForeignOrigin,
    InvalidRequest,
    Misdirected,
    MissingScope,
    ServiceUnavailable,
    Unauthorized,
    require_share,
)
from service.problems import CLOSE
from service.requests import is_json
from service.settings import ServiceSettings
from service.store.keys import KeyRecord, KeyStore
from service.store.owners import NO_OWNER, SERVICE, Owner, Scope

CALLER = "caller"  # in the state of the ASGI scope
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)  # RFC 6750, 2.1
LOOKUPS = 4  # threads for key lookups, separate from those of slow routes
# Requests for which a child process validates a file
UPLOAD = re.compile("(PUT|PATCH) /assets/.*|POST /assets|POST /lifts|POST (?P<plan>/lift/plan)")
# Routes without a key: they reveal nothing about anyone's data. The page asks for a key itself; the API documents are
# for people without a key, and browsers send no key with a link.
OPEN = frozenset(
    {
        "/", "/web/page.js", "/web/page.css", "/web/LICENSES.txt", "/healthz", "/readyz", "/version",
        "/web/example/point_cloud.spz", "/web/example/cameras.json", "/web/example/features.safetensors",
        "/openapi.json", "/docs", "/docs/swagger-ui-bundle.js", "/docs/swagger-ui.css",
    }
)  # fmt: skip
# Routes for the scope `shared`: the store shows such a key only the lifts that were shared with it.
SHARED = re.compile(r"/key|/lifts(/[^/]+(/(?!shares(/|$)).*)?)?|/query(/.*)?|/render")
SAFE = frozenset({"GET", "HEAD"})
WORKLESS = frozenset({"GET", "HEAD", "OPTIONS"})  # methods that start no work; a server that stops refuses all others
SCHEMES = {
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": f"A key that the operator made, with one or more of the scopes {', '.join(Scope)}.",
    }
}


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Caller:
    """The caller of a request."""

    owner: Owner
    max_uploads: int | None = None
    key: str | None = None  # the id of the key, for the log
    record: KeyRecord | None = None


LOCAL_ADMIN = Caller(SERVICE)  # while there are no keys
ANONYMOUS = Caller(NO_OWNER)  # on an open route


class AuthMiddleware:
    """ASGI middleware: store the `Caller` in the scope's state, or raise the reason for a refusal."""

    def __init__(self, app: ASGIApp, keys: KeyStore, settings: ServiceSettings, stopping: Callable[[], bool]) -> None:
        self._app = app
        self._keys = keys.under(settings.keys)
        self._settings = settings
        self._hosts = Hosts(settings.host, settings.allowed_hosts, settings.cors_origins)
        self._stopping = stopping
        self._uploads: Counter[str] = Counter()  # by key, uploads and plans in progress
        self._lookups = anyio.CapacityLimiter(LOOKUPS)

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Check a request and pass it on.

        Raises:
            ServiceError: it may not.
        """
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        method, headers = scope["method"], Headers(scope=scope)
        require_one_length(headers)
        scope_needed = required_scope(method, scope["path"])
        self._hosts.check(method, headers, only_reads=scope_needed is Scope.READ)
        caller = await self._caller(scope_needed, scope["path"], headers)
        if caller.key is not None and caller.owner.sees_all:
            fields = {"key": caller.key, "method": method, "path": scope["path"]}
            log.info("an admin key is used", extra={"fields": fields})
        if self._stopping() and method not in WORKLESS:
            busy = ServiceUnavailable(
                "server", expected="a running server", got="one that stops", hint="ask the next one"
            )
            busy.headers |= CLOSE
            raise busy
        scope.setdefault("state", {})[CALLER] = caller
        upload = UPLOAD.fullmatch(f"{method} {scope['path']}")
        if upload is None or (scope["path"] == "/lifts" and is_json(headers)):  # a JSON order, not an upload
            await self._app(scope, receive, send)
            return
        owner, limit = caller.owner.key, caller.max_uploads
        require_share("plan" if upload["plan"] else "upload", self._uploads[owner], limit)
        self._uploads[owner] += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._uploads[owner] -= 1
            if not self._uploads[owner]:
                del self._uploads[owner]

    async def _caller(self, required_scope_name: Scope | None, path: str, headers: Headers) -> Caller:
        if required_scope_name is None:
            return ANONYMOUS
        required, key = await anyio.to_thread.run_sync(self._keys.admit, bearer(headers), limiter=self._lookups)
        if not required:
            return LOCAL_ADMIN
        if key is None:
            has_header = "authorization" in headers
            code = ', error="invalid_token"' if has_header else ""  # only if a key was sent (RFC 6750, 3.1)
            raise Unauthorized(
                "Authorization", expected="Bearer and a key of this service",
                got="one that is not valid" if has_header else "none",
                hint="the operator makes keys with splatlift keys create",
                headers={"WWW-Authenticate": f'Bearer realm="splatlift"{code}'},
            )  # fmt: skip
        if not allows(key.scopes, required_scope_name, path):
            challenge = f'Bearer realm="splatlift", error="insufficient_scope", scope="{required_scope_name}"'
            raise MissingScope(
                "Authorization", expected=f"a key with the scope {required_scope_name}",
                got=f"one with {', '.join(sorted(key.scopes))}", headers={"WWW-Authenticate": challenge},
            )  # fmt: skip
        return self._caller_of(key)

    def _caller_of(self, key: KeyRecord) -> Caller:
        quota, settings = key.quota, self._settings
        owner = Owner(
            key=key.id,
            sees_all=Scope.ADMIN in key.scopes,
            max_bytes=settings.key_bytes if quota.max_bytes is None else quota.max_bytes,
            max_queued=settings.key_queued if quota.max_queued is None else quota.max_queued,
        )
        max_uploads = settings.key_uploads if quota.max_uploads is None else quota.max_uploads
        return Caller(owner, max_uploads, key.id, key)


def required_scope(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if it needs no key. Only the routes in `OPEN` need none."""
    if method in SAFE and path in OPEN:
        return None
    if path == "/metrics":
        return Scope.METRICS
    # A question may have a body.
    asks = method == "POST" and (path in ("/query", "/render") or path.startswith("/query/"))
    return Scope.READ if method in SAFE or asks else Scope.WRITE


def allows(scopes: frozenset[Scope], scope: Scope, path: str) -> bool:
    """Return True if a key with these scopes may do what needs that scope at that path."""
    if Scope.SHARED in scopes and scope is Scope.READ and SHARED.fullmatch(path):
        return True
    return scope in scopes or Scope.ADMIN in scopes


def bearer(headers: Headers) -> str | None:
    """Return the secret of the request's key; None if there is none or it is malformed."""
    values = headers.getlist("authorization")
    match = BEARER.fullmatch(values[0].strip()) if len(values) == 1 else None
    return None if match is None else match[1]


def require_one_length(headers: Headers) -> None:
    """Refuse a body with two declared lengths: a proxy may see another end than we do (RFC 9112, 6.1).

    Raises:
        InvalidRequest: there are both headers.
    """
    if "content-length" in headers and "transfer-encoding" in headers:
        raise InvalidRequest("Content-Length", expected="either it or Transfer-Encoding", got="both", headers=CLOSE)


class Hosts:
    """Names under which this service may be reached.

    Args:
        bound: the address that the service listens on. When that is all of them, every address in digits is this
            service: rebinding needs a name.
        allowed_hosts: other names of this server, such as that of a proxy.
        cors_origins: origins of other sites whose pages may read, `*` for all.
    """

    def __init__(self, bound: str, allowed_hosts: Iterable[str], cors_origins: Iterable[str] = ()) -> None:
        self._cors_origins = frozenset(cors_origins)
        self._allowed_hosts = frozenset(name.lower() for name in allowed_hosts)
        self._names = LOOPBACK | {bound.lower()} | self._allowed_hosts
        self._all_addresses = _is_address(bound) and ipaddress.ip_address(bound).is_unspecified

    def check(self, method: str, headers: Headers, *, only_reads: bool = False) -> None:
        """Check that a request is for this service, and that no page of another site sends it without permission.

        Args:
            method, headers: of the request.
            only_reads: True if it changes nothing although its method may: a query with a body.

        Raises:
            Misdirected: the Host is another.
            ForeignOrigin: it would change something, and comes from a page of another site.
        """
        hosts = headers.getlist("host")
        name = host_name(hosts[0]) if len(hosts) == 1 else None
        if name is None or not (name in self._names or (self._all_addresses and _is_address(name))):
            raise Misdirected(
                "Host", expected="a name of this service", got=", ".join(hosts)[:200] or "none",
                hint="the operator may add names with SPLATLIFT_ALLOWED_HOSTS",
            )  # fmt: skip
        origins = headers.getlist("origin")
        if method in SAFE or (only_reads and all(self._may_read(origin) for origin in origins)):
            return
        if any(not self._same_site(origin, hosts[0]) for origin in origins):
            raise ForeignOrigin("Origin", expected="this service's own page", got=", ".join(origins)[:200])

    def _may_read(self, origin: str) -> bool:
        return "*" in self._cors_origins or origin.lower() in self._cors_origins

    def _same_site(self, origin: str, host: str) -> bool:
        try:
            authority = urlsplit(origin).netloc.lower()
        except ValueError:
            return False
        return authority != "" and (authority == host.lower() or host_name(authority) in self._allowed_hosts)


def host_name(host: str) -> str | None:
    """Return the name in a Host header: lower case, without port and brackets; None if it is malformed."""
    name, bracket, rest = host.strip().lower().rpartition("]")
    if bracket:
        name = name.removeprefix("[")
        return name if _is_address(name) and _is_port(rest) else None
    name, colon, port = rest.partition(":")
    return name.removesuffix(".") if name and _is_port(colon + port) else None


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach the address."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _is_port(text: str) -> bool:
    digits = text.removeprefix(":")
    return text in ("", ":") or (text != digits and digits.isascii() and digits.isdigit())


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def with_keys(document: dict[str, Any]) -> dict[str, Any]:
    """Return an OpenAPI document that marks the operations that need a key."""
    paths = {
        path: {method: _secured(method, path, operation) for method, operation in operations.items()}
        for path, operations in document["paths"].items()
    }
    return {**document, "paths": paths, "components": {**document["components"], "securitySchemes": SCHEMES}}


def _secured(method: str, path: str, operation: dict[str, Any]) -> dict[str, Any]:
    scope = required_scope(method.upper(), path)
    return operation if scope is None else {**operation, "security": [{"key": [scope]}]}
