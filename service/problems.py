"""The one table from errors to HTTP answers, and the RFC 9457 shape of every one of them."""

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
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")  # and HEAD, where there is GET
PATH_CHARACTERS = 200  # of what a client asked for, told back
SHOWN = 120  # characters of a value that came
SHOWN_OF_JSON = 20  # from where it is none
PYDANTIC = re.compile(
    r"^\w+ should (be|have) |, unable to parse .*| after validation, not \d+$"
)  # around what it expects
CLOSE = {"Connection": "close"}  # what is still to come of the body would be taken for the next request
# Of the database's file, or of the disk below it: nobody's request is at fault, and nothing was kept of it.
UNUSABLE = (
    sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOTADB,
)  # fmt: skip
# Of the disk: it may only be read, fails, or was taken away.
UNWRITABLE = (errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ENODEV, errno.ESTALE)
NO_SPACE = "There is no room left"
BUSY = "The server is busy"
MALFORMED = "The request is malformed"

# Exception of the library -> status and title, of the nearest class in its ancestry; `type` is its `kind`.
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
    core.NotFound: (404, "There is no such thing here"),
    core.Unavailable: (422, "This server lacks what that needs"),
}

# Errors that the framework raises by status, not by class.
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
    """The error as a problem."""
    if isinstance(error, errors.ServiceError):
        status, title = error.status, error.title
    else:
        status, title = next(TABLE[cls] for cls in type(error).__mro__ if cls in TABLE)
    return Problem(
        type=f"/problems/{error.kind}", title=title, status=status, detail=str(error), hint=error.hint or None,
        argument=error.argument, expected=error.expected, got=error.got,
        nearest=None if error.nearest is None else list(error.nearest),
    )  # fmt: skip


def by_status(status: int, detail: str, **told: Any) -> Problem:
    """A problem that no error of ours tells of."""
    phrase = HTTPStatus(status).phrase
    slug, title = FRAMEWORK.get(status, (phrase.lower().replace(" ", "-"), phrase))
    return Problem(type=f"/problems/{slug}", title=title, status=status, detail=detail, **told)


def answer(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """The problem as a response to the request that is worked for."""
    problem = problem.model_copy(update={"request_id": current_id()})
    fields = {name: _plain(value) for name, value in problem.model_dump(exclude_none=True).items()}
    return JSONResponse(fields, problem.status, headers=headers, media_type=MEDIA_TYPE)


def answer_to(error: SplatliftError, more: Mapping[str, str] | None = None) -> JSONResponse:
    """The error as a response, with the headers that belong to it, and more."""
    headers = error.headers if isinstance(error, errors.ServiceError) else {}
    return answer(problem_of(error), {**headers, **(more or {})})


def install(app: FastAPI) -> None:
    """Make every error of the application a problem."""
    for kind in (SplatliftError, RequestValidationError, HTTPException, ClientDisconnect, OSError, sqlite3.Error):
        app.add_exception_handler(kind, _tell)
    app.add_exception_handler(Exception, _tell)  # of the layers, too: the gate raises what it refuses


# Async: a sync handler would wait for a thread of the pool, and a bad request behind every slow route.
async def _tell(request: Request, error: Exception) -> JSONResponse:
    match error:
        case SplatliftError():
            return answer_to(error)
        case RequestValidationError():
            return answer_to(refusal(request, error))
        case HTTPException():
            return _of_framework(request, error)
        case ClientDisconnect():  # nobody reads this; without it the log would tell of an error of ours
            return answer(by_status(400, "The client left before the end of the body."))
    return _of_system(f"{request.method} {request.url.path}", error)


def _of_system(what: str, error: Exception) -> JSONResponse:
    """What is the operator's to mend, or ours. Details go to the log: they may name what is not the client's."""
    code = getattr(error, "sqlite_errorcode", None)
    if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or code == sqlite3.SQLITE_FULL:
        log.error("%s: the disk is full", what)
        detail = "The server's disk is full; what was sent is not kept."
        return answer(Problem(type="/problems/no-space", title=NO_SPACE, status=507, detail=detail))
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        log.error("%s: the data directory cannot be used", what, exc_info=error)
        got = f"another: {error.strerror}"  # without its file, which is the server's
        return answer_to(errors.NotReady("disk", expected="a disk that can be read and written", got=got))
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        log.error("%s: no file can be opened any more", what)
        return answer_to(errors.Busy("files", expected="a file to open", got="as many open files as there may be"))
    if code is not None and code & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        log.error("%s: another process holds the database", what)
        return answer_to(errors.Busy("database", expected="a turn at it", got="one that another process holds"))
    if code is not None and code & 0xFF in UNUSABLE:
        log.error("%s: the database cannot be used", what, exc_info=error)
        got = "one that is damaged, gone, or on a disk that fails"
        return answer_to(errors.NotReady("database", expected="the database that was opened", got=got))
    log.error("%s failed", what, exc_info=error)
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
    """What the path takes, by all of its routes: the framework tells of the first one only."""
    scopes = {method: {**request.scope, "method": method} for method in METHODS}
    routes = request.app.routes
    methods = [
        method
        for method, scope in scopes.items()
        if any(route.matches(dict(scope))[0] is Match.FULL for route in routes)
    ]
    return [*methods, "HEAD"] if "GET" in methods else methods


def refusal(request: Request, error: RequestValidationError) -> errors.ServiceError:
    """The first thing that is wrong with the form of a request: where, what was expected, what came."""
    first = error.errors()[0]
    place, kind, context = [str(part) for part in first["loc"]], first["type"], first.get("ctx", {})
    if kind == "json_invalid":
        return _no_json(error.body, int(place[1]), context["error"])
    if place == ["body"] and isinstance(first.get("input"), bytes):
        return _unread(request.headers.get("content-type"))
    got = "nothing" if kind == "missing" else _short(first.get("input"))
    if kind == "unknown_field":  # told of what holds it, `service.models.Body`
        place.append(context["field"])
        got = repr(context["field"])
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


def _no_json(body: str, place: int, reason: str) -> errors.UnreadableBody:
    excerpt = repr(body[place : place + SHOWN_OF_JSON]) if place < len(body) else "its end"
    got = f"{excerpt} at character {place + 1} ({reason[:1].lower()}{reason[1:]})"
    return errors.UnreadableBody("body", expected="JSON", got=got, hint="in the body of the request")


def _unread(media: str | None) -> errors.UnsupportedMedia:
    """A body that is not read, as nothing says that it is JSON: curl says that all it sends is a form."""
    return errors.UnsupportedMedia(
        "Content-Type", expected="application/json", got="nothing" if media is None else _short(media),
        hint="send the header Content-Type: application/json with the body",
    )  # fmt: skip


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _plain(value: Any) -> Any:
    """Text on one line that UTF-8 can carry: what a client sent may be half a surrogate pair, or hold line ends."""
    if not isinstance(value, str):
        return value
    return " ".join(value.encode("utf-8", "backslashreplace").decode().split())
