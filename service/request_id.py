"""The id of a request: the client's own when it is a sane one, else ours; known to all that is done for it."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

HEADER = b"x-request-id"
SANE = re.compile(rb"[A-Za-z0-9._~+/=:@-]{1,128}")  # no space, quote or control character: safe in any log

_CURRENT: ContextVar[str | None] = ContextVar("request_id", default=None)


def chosen(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """The id for a request with these headers (names in lower case)."""
    sent = [value for name, value in headers if name == HEADER]
    if len(sent) == 1 and SANE.fullmatch(sent[0]):
        return sent[0].decode("ascii")
    return secrets.token_hex(16)


def current() -> str | None:
    """The id of the request that this task or thread works for, None when it works for none."""
    return _CURRENT.get()


@contextmanager
def working_for(request: str | None) -> Iterator[None]:
    """What is done in the block, and in threads that it awaits, is done for that request."""
    token = _CURRENT.set(request)
    try:
        yield
    finally:
        _CURRENT.reset(token)
