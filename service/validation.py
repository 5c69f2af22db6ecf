"""What a client is told when a request does not have the form that its route declares."""

from __future__ import annotations

from typing import Any

from fastapi import Request
from fastapi.exceptions import RequestValidationError

from service.errors import InvalidRequest

SHOWN = 120  # characters of what came
SHOWN_OF_JSON = 20  # from where it is none
OBJECT = "a JSON object"


def refusal(request: Request, error: RequestValidationError) -> InvalidRequest:
    """The first thing that is wrong: where, what was expected, what came."""
    first = error.errors()[0]
    place, kind, told = [str(part) for part in first["loc"]], first["type"], first.get("ctx", {})
    if kind == "json_invalid":
        return _no_json(error.body, int(place[1]), told["error"])
    if place == ["body"] and isinstance(first.get("input"), bytes):
        return _unread(request.headers.get("content-type"))
    got = "nothing" if kind == "missing" else _short(first.get("input"))
    if kind == "unknown_field":  # told of what holds it, `service.fields.Body`
        place.append(told["field"])
        got = repr(told["field"])
    return InvalidRequest(
        ".".join(place[1:]) or place[0],
        expected=OBJECT if place == ["body"] else _expected(first),
        got=got,
        hint=f"in the {place[0]} of the request",
    )


def _expected(told: dict[str, Any]) -> str:
    if told["type"] == "missing":
        return "a value"
    words = told["msg"].removeprefix("Input should be ")
    return told.get("ctx", {}).get("expected") or words[:1].lower() + words[1:]


def _no_json(body: str, place: int, why: str) -> InvalidRequest:
    shown = repr(body[place : place + SHOWN_OF_JSON]) if place < len(body) else "its end"
    got = f"{shown} at character {place + 1} ({why[:1].lower()}{why[1:]})"
    return InvalidRequest("body", expected="JSON", got=got, hint="in the body of the request")


def _unread(media: str | None) -> InvalidRequest:
    """A body that is not read, as nothing says that it is JSON: curl says that all it sends is a form."""
    return InvalidRequest(
        "Content-Type", expected="application/json", got="nothing" if media is None else _short(media),
        hint="send the header Content-Type: application/json with the body",
    )  # fmt: skip


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
