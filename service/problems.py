"""Convert every error to an HTTP answer in the shape of RFC 9457, by one table."""

from __future__ import annotations

import errno
import logging
import re
import sqlite3
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from liftcore import errors as core
from liftcore.errors import SplatliftError
from service import errors
from service.models import Problem
from service.observe import current_id

MEDIA_TYPE = "application/problem+json"
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")  # HEAD too, where GET is allowed
PATH_CHARACTERS = 200  # of a requested path, in an answer
VALUE_CHARACTERS = 120  # of a value, in an answer
JSON_CHARACTERS = 20  # of JSON, from the character where it is malformed
# Text around the expected value.
PYDANTIC = re.compile(r"^\w+ should (be|have) |, unable to parse .*| after validation, not \d+$")
CLOSE = {"Connection": "close"}  # the rest of the body must not be taken for the next request
# Errors of the database's file or the disk below it: the request is not at fault, and nothing was stored.
UNUSABLE = (
    sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOTADB,
)  # fmt: skip
# Errors of the disk: read-only, failing or removed.
UNWRITABLE = (errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ENODEV, errno.ESTALE)
NO_SPACE = "There is no space left"
BUSY = "The server is busy"
MALFORMED = "The request is malformed"

# Exception of the library -> status and title, by the nearest class in its ancestry; `type` is its `kind`.
TABLE: dict[type[SplatliftError], tuple[int, str]] = {
    SplatliftError: (422, "The input is not usable"),
    core.InvalidInput: (422, "The input is malformed"),
    core.InvalidSplats: (422, "The splats are malformed"),
    core.InvalidCameras: (422, "The cameras are malformed or not supported"),
    core.InvalidFeatures: (422, "The features are malformed or do not fit the scene"),
    core.InvalidMasks: (422, "The masks are malformed"),
    core.InvalidPhotos: (422, "The photos are malformed"),
    core.InvalidTable: (422, "The text table is malformed"),
    core.InvalidLift: (422, "The lift is not usable"),
    core.InvalidSettings: (422, "A setting is unknown or out of range"),
    core.InvalidQuery: (422, "The query cannot be answered as asked"),
    core.NotFound: (404, "There is no such resource"),
    core.Unavailable: (422, "This server lacks what that needs"),
}

# Errors that the framework raises with a status.
FRAMEWORK: dict[int, tuple[str, str]] = {
    400: ("malformed-request", MALFORMED),
    404: ("no-such-route", "There is no such route"),
    405: ("method-not-allowed", "The route does not take this method"),
    503: ("busy", BUSY),
}

# For OpenAPI: every route may answer with a problem.
PROBLEM: dict[str, Any] = {
    "description": "A problem (RFC 9457)",
    "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
}
RESPONSES: dict[int | str, dict[str, Any]] = dict.fromkeys(("4XX", "5XX"), PROBLEM)

log = logging.getLogger(__name__)


def problem_of(error: SplatliftError) -> Problem:
    """Return the error as a problem."""
    if isinstance(error, errors.ServiceError):
        status, title = error.status, error.title
    else:
        status, title = next(TABLE[cls] for cls in type(error).__mro__ if cls in TABLE)
    return Problem(
        type=f"/problems/{error.kind}", title=title, status=status, detail=str(error), hint=error.hint or None,
        argument=error.argument, expected=error.expected, got=error.got,
        nearest=None if error.nearest is None else list(error.nearest),
    )  # fmt: skip


def by_status(status: int, detail: str, **fields: Any) -> Problem:
    """Return a problem for a status without an error class."""
    phrase = HTTPStatus(status).phrase
    slug, title = FRAMEWORK.get(status, (phrase.lower().replace(" ", "-"), phrase))
    return Problem(type=f"/problems/{slug}", title=title, status=status, detail=detail, **fields)


def answer(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the problem as a response to the current request."""
    problem = problem.model_copy(update={"request_id": current_id()})
    fields = {name: _one_line(value) for name, value in problem.model_dump(exclude_none=True).items()}
    return JSONResponse(fields, problem.status, headers=headers, media_type=MEDIA_TYPE)


def answer_to(error: SplatliftError, headers_beside: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the error as a response, with its headers and others."""
    headers = error.headers if isinstance(error, errors.ServiceError) else {}
    return answer(problem_of(error), {**headers, **(headers_beside or {})})


def install(app: FastAPI) -> None:
    """Convert every error of the application to a problem."""
    for kind in (SplatliftError, RequestValidationError, HTTPException, ClientDisconnect, OSError, sqlite3.Error):
        app.add_exception_handler(kind, _handle_error)
    app.add_exception_handler(Exception, _handle_error)  # of the middleware too: `service.auth` raises its refusals


# Async: a sync handler would wait for a thread of the pool, and a malformed request behind every slow route.
async def _handle_error(request: Request, error: Exception) -> JSONResponse:
    match error:
        case SplatliftError():
            return answer_to(error)
        case RequestValidationError():
            return answer_to(refusal(request, error))
        case HTTPException():
            return _of_framework(request, error)
        case ClientDisconnect():  # the client is gone; without this the log would show an error of the server
            return answer(by_status(400, "The client left before the end of the body."))
    return _of_system(f"{request.method} {request.url.path}", error)


def _of_system(request_line: str, error: Exception) -> JSONResponse:
    """Answer an error of the server or its operator. Details go to the log only: they may name private things."""
    code = getattr(error, "sqlite_errorcode", None)
    if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or code == sqlite3.SQLITE_FULL:
        log.error("%s: the disk is full", request_line)
        detail = "The server's disk is full; what was sent is not kept."
        return answer(Problem(type="/problems/no-space", title=NO_SPACE, status=507, detail=detail))
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        log.error("%s: the data directory cannot be used", request_line, exc_info=error)
        got = f"another: {error.strerror}"  # without its file, which is private
        return answer_to(errors.NotReady("disk", expected="a disk that can be read and written", got=got))
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        log.error("%s: no file can be opened any more", request_line)
        return answer_to(
            errors.ServiceUnavailable("files", expected="a file to open", got="as many open files as there may be")
        )
    if code is not None and code & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        log.error("%s: another process holds the database", request_line)
        return answer_to(
            errors.ServiceUnavailable("database", expected="a turn at it", got="one that another process holds")
        )
    if code is not None and code & 0xFF in UNUSABLE:
        log.error("%s: the database cannot be used", request_line, exc_info=error)
        got = "one that is damaged, gone, or on a disk that fails"
        return answer_to(errors.NotReady("database", expected="the database that was opened", got=got))
    log.error("%s failed", request_line, exc_info=error)
    detail = "Something went wrong on our side; the server's log has the details."
    return answer(Problem(type="/problems/internal", title="An error of the server", status=500, detail=detail))


def _of_framework(request: Request, error: HTTPException) -> JSONResponse:
    method = request.method[:PATH_CHARACTERS]
    headers, fields, detail = dict(error.headers or {}), {}, error.detail
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        headers["Allow"] = ", ".join(_methods_of(request))
        fields = {"argument": "method", "expected": f"one of {headers['Allow']}", "got": method}
        detail = f"expected {fields['expected']}, got {method}"
    if error.status_code == HTTPStatus.NOT_FOUND:
        fields = {
            "argument": "path",
            "expected": "a route of this service",
            "got": request.url.path[:PATH_CHARACTERS],
        }
        fields["hint"] = "GET /docs shows them all"
        detail = f"expected {fields['expected']}; {fields['hint']}"
    request_line = f"{method} {request.url.path[:PATH_CHARACTERS]}"
    return answer(by_status(error.status_code, f"{request_line}: {detail}", **fields), headers)


def _methods_of(request: Request) -> list[str]:
    """Return the methods that a path accepts over all of its routes: the framework names the first route's only."""
    scopes = {method: {**request.scope, "method": method} for method in METHODS}
    routes = request.app.routes
    methods = [
        method
        for method, scope in scopes.items()
        if any(route.matches(dict(scope))[0] is Match.FULL for route in routes)
    ]
    return [*methods, "HEAD"] if "GET" in methods else methods


def refusal(request: Request, error: RequestValidationError) -> errors.ServiceError:
    """Return the first error in the form of a request: its place, the expected value, the value."""
    first = error.errors()[0]
    place, kind, context = [str(part) for part in first["loc"]], first["type"], first.get("ctx", {})
    if kind == "json_invalid":
        return _malformed_json(error.body, int(place[1]), context["error"])
    if place == ["body"] and isinstance(first.get("input"), bytes):
        return _not_json(request.headers.get("content-type"))
    got = "nothing" if kind == "missing" else _short(first.get("input"))
    if "field" in context:  # reported for the object that holds it (`liftcore.runtime.fields`)
        place.append(context["field"])
        got = repr(context["field"]) if kind == "unknown_field" else context["got"]
    return errors.InvalidRequest(
        ".".join(place[1:]) or place[0],
        expected="a JSON object" if place == ["body"] else _expected(first),
        got=got,
        hint=f"in the {place[0]} of the request",
    )


def _expected(error: dict[str, Any]) -> str:
    if error["type"] == "missing":
        return "a value"
    if error["type"] == "int_parsing_size":
        return "an integer of fewer digits"
    words = PYDANTIC.sub("", error["msg"]).replace("String should match pattern", "text that matches pattern")
    return error.get("ctx", {}).get("expected") or words[:1].lower() + words[1:]


def _malformed_json(body: str, place: int, reason: str) -> errors.UnreadableBody:
    excerpt = repr(body[place : place + JSON_CHARACTERS]) if place < len(body) else "its end"
    got = f"{excerpt} at character {place + 1} ({reason[:1].lower()}{reason[1:]})"
    return errors.UnreadableBody("body", expected="JSON", got=got, hint="in the body of the request")


def _not_json(media: str | None) -> errors.UnsupportedMedia:
    """Return the error for a body that is not declared as JSON: curl declares a form by default."""
    return errors.UnsupportedMedia(
        "Content-Type", expected="application/json", got="nothing" if media is None else _short(media),
        hint="send the header Content-Type: application/json with the body",
    )  # fmt: skip


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= VALUE_CHARACTERS else f"{text[:VALUE_CHARACTERS]}..."


def _one_line(value: Any) -> Any:
    """Return text as one line that UTF-8 can carry: a client may send half a surrogate pair, or line ends."""
    if not isinstance(value, str):
        return value
    return " ".join(value.encode("utf-8", "backslashreplace").decode().split())
