"""Errors of the service in the project's one tree of errors, and every error as an RFC 9457 problem."""

from __future__ import annotations

import errno
import logging
import re
import reprlib
import sqlite3
from collections.abc import Mapping
from contextvars import ContextVar
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from liftcore.errors import NotFound, SplatliftError

MEDIA_TYPE = "application/problem+json"
FULL = (errno.ENOSPC, errno.EDQUOT)
SHORT = reprlib.Repr()  # of a value of a request, in an answer
SHORT.maxstring = SHORT.maxother = 120
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE")
FIELDS = ("argument", "expected", "got", "hint", "nearest")
# Words of pydantic around the expected value
PYDANTIC = re.compile(r"^\w+ should (be|have) |, unable to parse .*| after validation, not \d+$")
# Of answers by their status; after 400 and 413 the rest of a body must not be taken for the next request
HEADERS: dict[int, dict[str, str]] = {
    400: {"Connection": "close"}, 401: {"WWW-Authenticate": 'Bearer realm="splatlift"'},
    413: {"Connection": "close"}, 503: {"Retry-After": "2"},
}  # fmt: skip
REQUEST_ID: ContextVar[str | None] = ContextVar("request_id", default=None)  # of this task, or the thread it awaits

log = logging.getLogger(__name__)


class ServiceError(SplatliftError):
    """An error of the service, and the status of its problem."""

    kind, status = "service", 422


class InvalidRequest(ServiceError):
    """A parameter or a body that the route does not accept."""

    kind = "invalid-request"


class OutOfTime(InvalidRequest):
    """A file or a request whose process takes more seconds than it may."""


class MalformedRequest(ServiceError):
    """A body that is not JSON, or a part of a file; or a request whose end a proxy may see elsewhere."""

    kind, status = "malformed-request", 400


class KeyReused(ServiceError):
    """An Idempotency-Key that was used with another order."""

    kind = "key-reused"


class Unauthorized(ServiceError):
    """No key, or a key that is not valid."""

    kind, status = "unauthorized", 401


class Forbidden(ServiceError):
    """A key without the scope that is needed, or a page of another site."""

    kind, status = "forbidden", 403


class Conflict(ServiceError):
    """The state of the resource does not allow the operation."""

    kind, status = "conflict", 409


class VersionMismatch(ServiceError):
    """The resource has another version than the one in If-Match."""

    kind, status = "changed", 412


class TooLarge(ServiceError):
    """More bytes than the operator allows."""

    kind, status = "too-large", 413


class TooManyParameters(ServiceError):
    """More parameters of a query than any use has: parsing them would delay other requests."""

    kind, status = "too-many-parameters", 414


class UnsupportedMedia(ServiceError):
    """A body in an encoding or of a media type that the route does not accept."""

    kind, status = "unsupported-media-type", 415


class Misdirected(ServiceError):
    """A Host header with a name that is not this service's."""

    kind, status = "misdirected", 421


class ProcessDied(ServiceError):
    """A process of the service died without an answer."""

    kind, status = "crashed", 500


class Busy(ServiceError):
    """A failure that may pass: the client may send the request again."""

    kind, status = "busy", 503


class TimedOut(ServiceError):
    """A query that took longer than the operator allows."""

    kind, status = "timed-out", 504


class NoSpace(ServiceError):
    """Less free disk than the operator reserves."""

    kind, status = "no-space", 507


class Misconfigured(ServiceError):
    """Settings or a data directory with which the service cannot start."""

    kind = "misconfigured"


class Problem(BaseModel):
    """An RFC 9457 problem; the fields after ``detail`` are there when the error names them."""

    type: str = Field(description="a stable URI reference, /problems/ and a slug")
    title: str
    status: int
    detail: str
    argument: str | None = None
    expected: str | None = None
    got: str | None = None
    hint: str | None = None
    nearest: list[str] | None = Field(None, description="for an unknown word: known words near to it")
    request_id: str | None = Field(None, description="as in X-Request-ID; the log has it too")


PROBLEM: dict[str, Any] = {
    "description": "A problem (RFC 9457)",
    "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
}


class Fault(SplatliftError):
    """The error of another process, as `fault_of` made it there."""

    def __init__(self, fault: dict[str, Any]) -> None:
        Exception.__init__(self, fault)
        self.fault = fault

    def __str__(self) -> str:
        """Return the sentence of the other process."""
        return self.fault["detail"]


def fault_of(error: SplatliftError, names: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the error as the JSON of a problem, with clients' names for private paths of the server."""
    status = getattr(error, "status", 404 if isinstance(error, NotFound) else 422)
    fields = {name: value for name in FIELDS if (value := getattr(error, name, None))}
    document = {
        "type": f"/problems/{error.kind}", "title": error.kind.replace("-", " ").capitalize(), "status": status,
        "detail": str(error), **fields,
    }  # fmt: skip
    return {name: replace_names(value, names or {}) for name, value in document.items()}


def replace_names(value: Any, names: Mapping[str, str]) -> Any:
    """Return a text with paths of the server replaced by the names that the client knows."""
    if isinstance(value, str):
        for path, name in names.items():
            value = value.replace(path, name)
    return value


def answer(fault: dict[str, Any], headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return a fault as the response to the current request."""
    fields = fault | {"request_id": REQUEST_ID.get()}
    document = {name: _one_line(value) for name, value in fields.items() if value is not None}
    status = fault["status"]
    return JSONResponse(document, status, {**HEADERS.get(status, {}), **(headers or {})}, MEDIA_TYPE)


def _one_line(value: Any) -> Any:
    """Return text as one line that UTF-8 can carry: a client may send half a surrogate pair, or line ends."""
    return " ".join(value.encode("utf-8", "backslashreplace").decode().split()) if isinstance(value, str) else value


def answer_to(error: Exception, request_line: str = "") -> JSONResponse:
    """Return any error as a response."""
    match error:
        case Fault():
            reply = answer(error.fault)
        case SplatliftError():
            reply = answer(fault_of(error))
        case RequestValidationError():
            reply = answer_to(_refusal(error))
        case HTTPException():
            reply = _of_framework(error, request_line)
        case ClientDisconnect():
            reply = answer_to(MalformedRequest("body", expected="all of it", got="a client that left"))
        case _:
            reply = _of_system(error, request_line)
    return reply


def _of_system(error: Exception, request_line: str) -> JSONResponse:
    """Answer an error of the server. Its details go to the log: they may name private things."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if getattr(error, "errno", None) in FULL or code == sqlite3.SQLITE_FULL:
        log.error("%s: the disk is full", request_line)
        hint = "delete assets or lifts, or ask the operator for room"
        return answer_to(NoSpace("data", expected="room on the server's disk", got="a full disk", hint=hint))
    if isinstance(error, OSError | sqlite3.Error):
        log.warning("%s: the data directory cannot be used", request_line, exc_info=error)
        hint = "send it again; the server's log says why"
        return answer_to(Busy("data", expected="a disk and a database that can be used", got="an error", hint=hint))
    log.error("%s failed", request_line, exc_info=error)
    return answer_to(ProcessDied("server", expected="an answer", got="an error, of which the server's log has more"))


def _of_framework(error: HTTPException, request_line: str) -> JSONResponse:
    phrase = HTTPStatus(error.status_code).phrase
    slug = {404: "no-such-route", 400: "malformed-request"}.get(error.status_code, phrase.lower().replace(" ", "-"))
    detail = f"{request_line}: {error.detail}"
    fault = {"type": f"/problems/{slug}", "title": phrase, "status": error.status_code, "detail": detail}
    if error.status_code == HTTPStatus.NOT_FOUND:
        fault |= {"argument": "path", "expected": "a route of this service", "hint": "GET /docs shows them all"}
    return answer(fault, error.headers)


def _refusal(error: RequestValidationError) -> SplatliftError:
    """Return the first error in the form of a request: its place, the expected value, the value."""
    first = error.errors()[0]
    place, kind, context = [str(part) for part in first["loc"]], first["type"], first.get("ctx", {})
    hint = f"in the {place[0]} of the request"
    if kind == "json_invalid":
        got = f"an error at character {place[1]}: {context['error']}"
        return MalformedRequest("body", expected="JSON", got=got, hint=hint)
    if place == ["body"] and isinstance(first.get("input"), bytes):  # curl declares a form by default
        hint = "send the header Content-Type: application/json with the body"
        return UnsupportedMedia("Content-Type", expected="application/json", got="another, or none", hint=hint)
    got = "nothing" if kind == "missing" else SHORT.repr(first.get("input"))
    if kind == "unknown_field":  # reported for the object that holds it
        place.append(context["field"])
        got = repr(context["field"])
    expected = context.get("expected") or PYDANTIC.sub("", first["msg"])
    if kind in ("missing", "extra_forbidden"):
        expected = "a value" if kind == "missing" else "a field that the route takes"
    if place == ["body"]:
        expected = "a JSON object"
    if place[0] == "path":
        return NotFound(place[-1], expected=expected[:1].lower() + expected[1:], got=got)
    return InvalidRequest(
        ".".join(place[1:]) or place[0], expected=expected[:1].lower() + expected[1:], got=got, hint=hint
    )


def install(app: FastAPI) -> None:
    """Convert every error of the routes to a problem."""

    async def handle(request: Request, error: Exception) -> JSONResponse:
        if isinstance(error, HTTPException) and error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            scopes = {
                method: {**request.scope, "method": method} for method in METHODS
            }  # the framework names one route's
            allowed_methods = [
                method
                for method, scope in scopes.items()
                if any(route.matches(scope)[0] is Match.FULL for route in app.routes)
            ]
            error.headers = {"Allow": ", ".join(allowed_methods)}
        reply = answer_to(error, f"{request.method[:20]} {request.url.path[:200]}")
        # Else it holds the frames that raised it, and these hold it, with the body, up to a full garbage collection.
        error.__cause__ = error.__context__ = error.__traceback__ = None
        return reply

    errors = (SplatliftError, RequestValidationError, HTTPException, ClientDisconnect, OSError, sqlite3.Error)
    for kind in errors:
        app.add_exception_handler(kind, handle)
