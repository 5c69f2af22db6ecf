"""Read requests: known parameters, JSON bodies of a limited size, parsed in threads."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Annotated, Any, Generic, TypeVar, cast

import anyio
from fastapi import APIRouter, Body, Depends, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.datastructures import Headers
from starlette.routing import Match
from starlette.types import Scope

from service import models
from service.content import TAGGED
from service.errors import (
    InvalidRequest,
    ServiceError,
    TooLarge,
    UnreadableBody,
    UnsupportedEncoding,
    UnsupportedMedia,
)
from service.problems import CLOSE, refusal

NAME_CHARACTERS = 80  # of a name or a value of a request, in an answer
M = TypeVar("M", bound=models.Body)
F = TypeVar("F", bound=Callable[..., Any])
BODY = "in the body of the request"
JSON = re.compile(r"\s*application/([^;\s]+\+)?json\s*(;|$)", re.IGNORECASE)  # as the framework has it
PARTS = re.compile(r"\s*multipart/", re.IGNORECASE)  # the form of file uploads by HTML
LET_GO = 16  # times the limit of a body: an upload to the wrong route ends there


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _known_only(request: Request) -> None:
    """Refuse unknown query parameters rather than ignore them."""
    parameters = request.query_params
    if not parameters:
        return
    route: APIRoute = request.scope["route"]
    documented = (route.openapi_extra or {}).get("parameters", ())
    by_name = {parameter["name"]: parameter for parameter in documented if parameter["in"] == "query"}
    names = [*_names(route), *by_name]
    lists = {name for name, parameter in by_name.items() if parameter["schema"].get("type") == "array"}
    for name in parameters:
        if name not in names:
            raise InvalidRequest(
                name[:NAME_CHARACTERS], expected=f"one of {', '.join(names)}" if names else "no parameters",
                got=repr(name[:NAME_CHARACTERS]), hint="in the query of the request",
            )  # fmt: skip
        if len(values := parameters.getlist(name)) > 1 and name not in lists:  # the framework would take the last one
            raise InvalidRequest(
                name, expected="one value", got=f"{len(values)} of them", hint="in the query of the request"
            )


KnownParameters = Depends(_known_only)


def _names(route: APIRoute) -> Iterator[str]:
    """Yield the query parameters that a route declares, one by one or as the fields of a model."""
    for field in route.dependant.query_params:
        annotation = field.field_info.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from annotation.model_fields
        else:
            yield field.alias


class JsonRoute(APIRoute):
    """A route with a limited body, parsed and validated in a thread, as odd JSON of a megabyte takes long.

    While a request waits, only the validated model is in memory, not the body.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the framework's handler, after the body is read."""
        handle, body = super().get_route_handler(), self.body_field
        if body is None:
            return handle
        model = TypeAdapter(cast("type[Any]", body.field_info.annotation))

        async def with_body(request: Request) -> Response:
            bounded = _BoundedRequest(request.scope, request.receive)
            await bounded.read(model)
            return await handle(bounded)

        return with_body


class OrderRoute(JsonRoute):
    """A route for JSON bodies, beside a route for files with the same path: it must come first."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match requests whose Content-Type is JSON."""
        return super().matches(scope) if is_json(Headers(scope=scope)) else (Match.NONE, {})


def is_json(headers: Headers) -> bool:
    """Return True if a body is declared as JSON."""
    return JSON.match(headers.get("content-type", "")) is not None


def require_file(headers: Headers) -> None:
    """Require that a body is a plain file: neither compressed nor a part of a form.

    Raises:
        UnsupportedEncoding: its Content-Encoding says that it is compressed.
        UnsupportedMedia: its Content-Type says that it is a form.
    """
    require_plain(headers.getlist("content-encoding"))
    media = headers.get("content-type", "")
    if PARTS.match(media):
        raise UnsupportedMedia(
            "Content-Type", expected="the file itself as the body", got=repr(media[:NAME_CHARACTERS]),
            hint="send it with curl -T FILE or --data-binary @FILE, as application/octet-stream",
        )  # fmt: skip


class _BoundedRequest(Request):
    """A request whose body is read within the limit, and validated if it is JSON."""

    async def read(self, model: TypeAdapter[Any]) -> None:
        """Read and validate the body.

        Raises:
            UnsupportedEncoding: it is compressed.
            TooLarge: it is too long. A client that is still sending when its connection closes never reads the
                answer: a body that is a few times too long is read to its end and dropped.
            InvalidRequest: it holds too many values, or is not what the route takes.
            UnreadableBody: it cannot be parsed as JSON.
        """
        require_plain(self.headers.getlist("content-encoding"))
        deps, content, count = self.app.state.deps, bytearray(), 0
        limit = deps.settings.max_body_bytes
        async for chunk in self.stream():
            count += len(chunk)
            if count <= limit:
                content += chunk
            elif count > LET_GO * limit:
                raise _too_large(limit, CLOSE)
        if count > limit:
            raise _too_large(limit)
        self._begin, self._value = bytes(content[:NAME_CHARACTERS]), None
        if content and is_json(self.headers):  # else the framework refuses it unread
            self._value = await anyio.to_thread.run_sync(_validated, self, model, content, limiter=deps.parsing)
            if isinstance(self._value, ServiceError):
                raise self._value

    async def body(self) -> bytes:
        """Return the first bytes of the body: the framework checks that there is one, and quotes malformed JSON."""
        return self._begin

    async def json(self) -> Any:
        """Return the validated model, which the framework uses as it is."""
        return self._value


def _too_large(limit: int, headers: Mapping[str, str] | None = None) -> TooLarge:
    return TooLarge("body", expected=f"at most {limit} bytes", got="more", hint=BODY, headers=headers)


def require_plain(content_encodings: Sequence[str]) -> None:
    """Require that a body is not compressed.

    Raises:
        UnsupportedEncoding: its Content-Encoding says that it is compressed.
    """
    encodings = ", ".join(content_encodings)
    if encodings.strip().lower() not in ("", "identity"):
        raise UnsupportedEncoding(
            "Content-Encoding", expected="a body that is not compressed", got=encodings[:40],
            hint="send it as it is; .spz and .sog are compressed already",
        )  # fmt: skip


def _validated(request: Request, model: TypeAdapter[Any], content: bytearray) -> Any:
    """Return a body as a model, or its error; an exception raised here would keep the body in memory."""
    # Parsing these takes a tenth of a second of the event loop.
    if content.count(b"[") + content.count(b"{") > models.BODY_BRACKETS or content.count(b",") > models.BODY_COMMAS:
        expected = f"JSON of at most {models.BODY_COMMAS} values and {models.BODY_BRACKETS} lists and objects"
        return InvalidRequest("body", expected=expected, got="more", hint=BODY)
    try:
        return model.validate_python(json.loads(content))
    except json.JSONDecodeError as error:
        first = {"type": "json_invalid", "loc": ("body", error.pos), "ctx": {"error": error.msg}}
        return refusal(request, RequestValidationError([first], body=error.doc))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        return refusal(request, RequestValidationError([{**first, "loc": ("body", *first["loc"])}]))
    except UnicodeDecodeError:
        return UnreadableBody("body", expected="JSON in UTF-8", got="bytes that are none", hint=BODY)
    except (ValueError, RecursionError):
        got = "a number of thousands of digits, or brackets within brackets without end"
        return UnreadableBody("body", expected="JSON that can be read", got=got, hint=BODY)


@dataclass(frozen=True)
class Parameters(Generic[M]):
    """Dependency that gives a model of the parameters of a request.

    Args:
        model: of the request. names: its fields that are parameters. needs: those that are required.
    """

    model: type[M]
    names: tuple[str, ...]
    needs: tuple[str, ...] = ()

    async def __call__(self, request: Request) -> M:
        query, fields = request.query_params, self.schema["properties"]
        values = {
            name: query.getlist(name) if fields[name].get("type") == "array" else query[name]
            for name in self.names
            if name in query
        }
        try:
            model = self.model.model_validate(values)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise RequestValidationError([{**first, "loc": ("query", *first["loc"])}]) from None
        for name in self.needs:
            if name not in query:
                raise RequestValidationError([{"type": "missing", "loc": ("query", name), "msg": "", "input": None}])
        return model

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The fields as JSON schema."""
        return self.model.model_json_schema()

    def openapi_schema(self) -> dict[str, Any]:
        """Describe the parameters for OpenAPI."""
        parameters = []
        for name in self.names:
            schema = {key: value for key, value in self.schema["properties"][name].items() if key != "description"}
            if "anyOf" in schema.get("items", {}):  # the part of an example that a URL can hold
                schema["items"] = next(part for part in schema["items"]["anyOf"] if part["type"] == "string")
            about = self.schema["properties"][name].get("description", "")
            parameter = {"name": name, "in": "query", "required": name in self.needs, "schema": schema}
            parameters.append(parameter | {"description": about})
        return {"parameters": parameters}


def get_and_post(router: APIRouter, path: str, parameters: Parameters[Any], **route: Any) -> Callable[[F], F]:
    """Register an endpoint with an argument ``parameters`` for GET, and for a POST of the same as JSON."""

    def register(endpoint: F) -> F:
        answers = {"responses": route["responses"] | TAGGED} if "responses" in route else {}
        get = router.get(path, openapi_extra=parameters.openapi_schema(), **route | answers)
        get(_reading(endpoint, Annotated[parameters.model, Depends(parameters)]))
        post = router.post(path, name=f"{endpoint.__name__}_by_body", **route)
        post(_reading(endpoint, Annotated[parameters.model, Body()]))
        return endpoint

    return register


def _reading(endpoint: F, source: Any) -> F:
    """Return the endpoint, whose argument ``parameters`` has ``source`` as its annotation."""

    @wraps(endpoint)
    def reading(**arguments: Any) -> Any:
        return endpoint(**arguments)

    signature = inspect.signature(endpoint, eval_str=True)
    parameters = [
        parameter.replace(annotation=source) if parameter.name == "parameters" else parameter
        for parameter in signature.parameters.values()
    ]
    reading.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    return reading  # pyright: ignore[reportReturnType]
