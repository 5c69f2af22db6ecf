"""The gate: every request passes it, or is answered here. It leaves who asks in the scope, for the routes."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

import anyio
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from liftcore.errors import SplatliftError
from service import problems
from service.errors import MissingScope, TooMany, Unauthorized
from service.keys.hosts import Hosts
from service.keys.scopes import Scope, allows, needed
from service.limits import UPLOADS
from service.settings import ServiceSettings
from service.store.keys import KeyRecord, KeyStore
from service.store.owners import Owner

CALLER = "caller"  # of the scope's state
BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)  # RFC 6750, 2.1
LOOKERS = 4  # threads that look keys up, so that slow routes cannot keep anyone waiting at the gate


@dataclass(frozen=True)
class Caller:
    """Who asks."""

    owner: Owner
    max_uploads: int | None = None
    key: str | None = None  # its id, for the log


EVERYBODY = Caller(Owner())  # while there are no keys
STRANGER = Caller(Owner(key="-", sees_all=False))  # on an open route: the id of no key, so nothing is theirs


class Gate:
    """ASGI middleware: the Host and the Origin, then the key, then its scope, then its uploads at a time."""

    def __init__(self, app: ASGIApp, keys: KeyStore, settings: ServiceSettings) -> None:
        self._app = app
        self._keys = keys.under(settings.keys)
        self._settings = settings
        self._hosts = Hosts(settings.host, settings.allowed_hosts)
        self._uploads: Counter[str] = Counter()  # by key, those that are on their way
        self._lookers: anyio.CapacityLimiter | None = None

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Let the request pass, or say why not."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        try:
            caller = await self._caller(scope["method"], scope["path"], Headers(scope=scope))
            uploads = scope["method"] == "PUT" and scope["path"].startswith(UPLOADS)
            if uploads:
                self._require_turn(caller)
        except SplatliftError as error:
            await problems.answer_to(error)(scope, receive, send)
            return
        scope.setdefault("state", {})[CALLER] = caller
        self._uploads[caller.owner.key] += uploads
        try:
            await self._app(scope, receive, send)
        finally:
            self._uploads[caller.owner.key] -= uploads
            if not self._uploads[caller.owner.key]:
                del self._uploads[caller.owner.key]

    async def _caller(self, method: str, path: str, headers: Headers) -> Caller:
        self._hosts.check(method, headers)
        wanted = needed(method, path)
        if wanted is None:
            return STRANGER
        if self._lookers is None:
            self._lookers = anyio.CapacityLimiter(LOOKERS)
        secret = bearer(headers)
        required, key = await anyio.to_thread.run_sync(self._keys.admit, secret, limiter=self._lookers)
        if not required:
            return EVERYBODY
        if key is None:
            raise Unauthorized(
                "Authorization", expected="Bearer and a key of this service",
                got="one that is not valid" if "authorization" in headers else "none",
                hint="the operator makes keys with splatlift keys create",
            )  # fmt: skip
        if not allows(key.scopes, wanted):
            raise MissingScope(
                "Authorization", expected=f"a key with the scope {wanted}",
                got=f"one with {', '.join(sorted(key.scopes))}", scope=wanted,
            )  # fmt: skip
        return self._known(key)

    def _known(self, key: KeyRecord) -> Caller:
        quota, settings = key.quota, self._settings
        owner = Owner(
            key=key.id,
            sees_all=Scope.ADMIN in key.scopes,
            max_bytes=settings.key_bytes if quota.max_bytes is None else quota.max_bytes,
            max_queued=settings.key_queued if quota.max_queued is None else quota.max_queued,
        )
        uploads = settings.key_uploads if quota.max_uploads is None else quota.max_uploads
        return Caller(owner, uploads, key.id)

    def _require_turn(self, caller: Caller) -> None:
        if caller.max_uploads is not None and self._uploads[caller.owner.key] >= caller.max_uploads:
            raise TooMany(
                "upload", expected=f"at most {caller.max_uploads} uploads of this key at a time", got="more",
                hint="wait for the end of one",
            )  # fmt: skip


def bearer(headers: Headers) -> str | None:
    """The secret that a request brings, None when it brings none, or not as it should."""
    given = headers.getlist("authorization")
    match = BEARER.fullmatch(given[0].strip()) if len(given) == 1 else None
    return None if match is None else match[1]
