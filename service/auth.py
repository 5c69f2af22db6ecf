"""Who asks: host, origin, key and scope are checked before anything of a request is read.

Host and Origin come first: the threat is a page of another site in the browser of a user who can reach the service.
The page may send requests itself (Origin shows it), or let its own name resolve to this machine (DNS rebinding; Host
shows it).
"""

from __future__ import annotations

import ipaddress
import json
import re
from typing import Any
from urllib.parse import urlsplit

import anyio
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Forbidden, MalformedRequest, Misdirected, TooLarge, TooManyParameters, Unauthorized
from service.models import BITS_BYTES, BODY_BYTES, Key
from service.settings import ServiceSettings
from service.store import SERVICE, Owner, Store, admit

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
NOBODY = Owner("-")  # the id of no key: it owns nothing
SCOPES = ("read", "write", "admin")  # that an operator gives; admin: both, on the records of all owners
BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)  # RFC 6750, 2.1
# Routes without a key: they reveal nothing about anyone's data. The page asks for a key itself.
OPEN = re.compile(r"GET /(web/.+|healthz|readyz|openapi\.json|docs(/[^/]+)?)?")
READS = re.compile(r"(GET|HEAD) .*|POST /(query(/.*)?|render)")  # a question may have a body
SHARED = re.compile(r"/key|/lifts(/[^/]+(/(?!shares(/|$)).*)?)?|/query(/.*)?|/render")  # for keys with shared lifts
UPLOAD = re.compile(r"PUT /assets/.*|POST /lifts")  # whose limit is a setting
PARAMETERS = 1100  # of a query string: a picture may hide a thousand sets; each costs the event loop 5 us
SCHEME = {"type": "http", "scheme": "bearer", "description": f"A key with one or more of {', '.join(SCOPES)}."}


class Auth:
    """ASGI middleware: put the `Owner` and the `Key` into the scope's state, or raise a refusal."""

    def __init__(self, app: ASGIApp, store: Store, settings: ServiceSettings) -> None:
        self._app, self._store, self._upload_bytes = app, store, settings.upload_bytes
        self._allowed_hosts = frozenset(name.lower() for name in settings.allowed_hosts)
        self._hosts = LOOPBACK | {settings.host.lower()} | self._allowed_hosts
        is_any = is_address(settings.host) and ipaddress.ip_address(settings.host).is_unspecified
        self._takes_addresses = is_any  # rebinding needs a name
        self._lookups = anyio.CapacityLimiter(4)  # threads, separate from those of slow routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request and pass it on; `service.app.Recorder` answers refusals."""
        if scope["type"] == "http":
            headers, line = Headers(scope=scope), f"{scope['method']} {scope['path']}"
            require_clear_end(headers, line)
            self._require_host(scope["method"], headers)
            if (count := scope["query_string"].count(b"&") + 1) > PARAMETERS:
                expected, hint = f"at most {PARAMETERS} parameters", "POST them as a body"
                raise TooManyParameters("query", expected=expected, got=str(count), hint=hint)
            owner, key = await self._caller(headers, line)
            limit = BITS_BYTES if "/selections" in line else BODY_BYTES
            require_length(headers, self._upload_bytes if UPLOAD.fullmatch(line) else limit)
            scope.setdefault("state", {}).update(owner=owner, key=key)
        await self._app(scope, receive, send)

    async def _caller(self, headers: Headers, line: str) -> tuple[Owner, Key | None]:
        """Return who sends a request, and the key."""
        if OPEN.fullmatch(line):
            return NOBODY, None
        authorization = headers.getlist("authorization")
        match = BEARER.fullmatch(authorization[0].strip()) if len(authorization) == 1 else None
        secret = match[1] if match else None
        is_required, key = await anyio.to_thread.run_sync(admit, self._store, secret, limiter=self._lookups)
        if not is_required:
            return SERVICE, None
        if key is None:
            raise Unauthorized(
                "Authorization", expected="Bearer and a key of this service",
                got="one that is not valid" if authorization else "none",
                hint="the operator makes keys with splatlift keys create",
            )  # fmt: skip
        require_scope(key, line)
        return Owner(key.id, "admin" in key.scopes.split(), json.dumps(key.lifts)), key

    def _require_host(self, method: str, headers: Headers) -> None:
        """Require that a request is for this service, and that no page of another site sends it."""
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        name = host_name(hosts[0]) if len(hosts) == 1 else None
        if name is None or not (name in self._hosts or (self._takes_addresses and is_address(name))):
            hint = "the operator may add names with SPLATLIFT_ALLOWED_HOSTS"
            got = ", ".join(hosts)[:200] or "none"
            raise Misdirected("Host", expected="a name of this service", got=got, hint=hint)
        if method not in ("GET", "HEAD") and any(not self._is_own(origin, hosts[0].lower()) for origin in origins):
            raise Forbidden("Origin", expected="this service's own page", got=", ".join(origins)[:200])

    def _is_own(self, origin: str, host: str) -> bool:
        try:
            authority = urlsplit(origin).netloc.lower()
        except ValueError:
            return False
        return authority != "" and (authority == host or host_name(authority) in self._allowed_hosts)


def require_scope(key: Key, line: str) -> None:
    """Require that a key may do what needs a scope: of a request's method and path."""
    scopes, needed = key.scopes.split(), "read" if READS.fullmatch(line) else "write"
    is_shared = "shared" in scopes and needed == "read" and SHARED.fullmatch(line.partition(" ")[2])
    if not (needed in scopes or "admin" in scopes or is_shared):
        expected, got = f"a key with the scope {needed}", f"one with {', '.join(scopes)}"
        raise Forbidden("Authorization", expected=expected, got=got)


def require_clear_end(headers: Headers, line: str) -> None:
    """Require that a proxy sees the same end of a request (RFC 9112): what it takes for the rest is not answered."""
    if line.startswith("CONNECT "):
        raise MalformedRequest("method", expected="a method of a route", got="CONNECT")
    if "transfer-encoding" in headers and "content-length" in headers:
        raise MalformedRequest("Content-Length", expected="either it or Transfer-Encoding", got="both")


def require_length(headers: Headers, limit: int) -> None:
    """Require that the head of a request announces no more than may come, before a client is told to go on."""
    length = headers.get("content-length", "0")
    if length.isdigit() and int(length[:20]) > limit:
        hint = "several feature packs may make one lift, so features can be cut" if limit > BITS_BYTES else ""
        raise TooLarge("body", expected=f"at most {limit} bytes", got="more", hint=hint)


def host_name(host: str) -> str | None:
    """Return the name in a Host header: lower case, without port and brackets; None if it is malformed."""
    match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^\[\]:/@\\,\s]+?)\.?(:\d{0,5})?", host.strip().lower(), re.ASCII)
    return match[1].strip("[]") if match else None


def is_address(name: str) -> bool:
    """Return True for an IP address."""
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach the address."""
    return host == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)


def with_keys(document: dict[str, Any]) -> dict[str, Any]:
    """Return an OpenAPI document in which the operations that need a key say so, with its scope."""

    def needs(line: str) -> dict[str, Any]:
        scope = "read" if READS.fullmatch(line) else "write"
        return {} if OPEN.fullmatch(line) else {"security": [{"key": [scope]}]}

    paths = {
        path: {method: operation | needs(f"{method.upper()} {path}") for method, operation in operations.items()}
        for path, operations in document["paths"].items()
    }
    return document | {"paths": paths, "components": document["components"] | {"securitySchemes": {"key": SCHEME}}}
