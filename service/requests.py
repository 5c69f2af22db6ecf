"""How requests are read: parameters that are known, JSON bodies of a bounded size, parsed beside the event loop."""

from __future__ import annotations

import email.message
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Generic, TypeVar

import anyio
from fastapi import APIRouter, Depends, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from pydantic.json_schema import JsonSchemaMode, models_json_schema
from starlette.exceptions import HTTPException

from liftcore.runtime.fields import NAME_CHARACTERS, one_of
from service import limits
from service.content import TAGGED
from service.errors import InvalidRequest, UnreadableBody
from service.problems import CLOSE

M = TypeVar("M", bound=BaseModel)
F = TypeVar("F", bound=Callable[..., Any])
SCHEMAS = "#/components/schemas/"
BODY = "in the body of the request"
_BODIES: dict[str, type[BaseModel]] = {}  # by their names, which the documents refer to
LET_GO = 16  # times the limit of a body: an upload sent to the wrong route ends there


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _known_only(request: Request) -> None:
    """Refuse query parameters that the route does not know: passed over, they would seem to have been heard."""
    given = request.query_params
    if not given:
        return
    route: APIRoute = request.scope["route"]
    described = [parameter["name"] for parameter in (route.openapi_extra or {}).get("parameters", ())]
    known = [*_names(route), *described]
    for name in given:
        if name not in known:
            raise InvalidRequest(
                name[:NAME_CHARACTERS], expected=one_of(known) if known else "no parameters",
                got=repr(name[:NAME_CHARACTERS]), hint="in the query of the request",
            )  # fmt: skip


KnownParameters = Depends(_known_only)


def _names(route: APIRoute) -> Iterator[str]:
    """The query parameters that a route declares, one by one or as the fields of a model."""
    for field in route.dependant.query_params:
        declared = field.field_info.annotation
        if isinstance(declared, type) and issubclass(declared, BaseModel):
            yield from declared.model_fields
        else:
            yield field.alias


async def _body(request: Request) -> bytes:
    """The body of a request that has one to read, within its limit.

    A client that is still sending when its connection closes never reads the answer: what is a few times too long is
    read to its end and let go.
    """
    body, limit, received = bytearray(), request.app.state.deps.settings.max_body_bytes, 0
    if request.method not in ("POST", "PATCH"):
        return b""
    async for chunk in request.stream():
        received += len(chunk)
        if received <= limit:
            body += chunk
        elif received > LET_GO * limit:
            raise HTTPException(413, f"the body has more than {limit} bytes", CLOSE)
    if received > limit:
        raise HTTPException(413, f"the body has more than {limit} bytes")
    return bytes(body)


BodyBytes = Annotated[bytes, Depends(_body)]


def json_body(model: type[BaseModel]) -> Any:
    """A dependency that gives the body as a model. The framework would parse and validate it on the event loop, where
    a megabyte of odd JSON keeps everybody waiting; `described_body` says in OpenAPI what the framework would.
    """

    async def parse(request: Request, content: BodyBytes) -> BaseModel:
        media = request.headers.get("content-type")
        return await anyio.to_thread.run_sync(_parsed, model, content, media, limiter=request.app.state.deps.parsing)

    return Depends(parse)


def _parsed(model: type[M], content: bytes, media: str | None) -> M:
    if not content:
        raise _refused("missing", "Field required", None)
    if not _is_json(media):
        raise _refused("model_type", "Input should be JSON", content)
    # To parse them takes a tenth of a second of everybody's time, whatever they are.
    if content.count(b"[") + content.count(b"{") > limits.BODY_BRACKETS or content.count(b",") > limits.BODY_COMMAS:
        expected = f"JSON of at most {limits.BODY_COMMAS} values and {limits.BODY_BRACKETS} lists and objects"
        raise InvalidRequest("body", expected=expected, got="more", hint=BODY)
    try:
        return _checked(model, json.loads(content), "body")
    except json.JSONDecodeError as error:
        told = {"type": "json_invalid", "loc": ("body", error.pos), "msg": "", "ctx": {"error": error.msg}}
        raise RequestValidationError([told], body=error.doc) from None
    except UnicodeDecodeError:
        raise UnreadableBody("body", expected="JSON in UTF-8", got="bytes that are none", hint=BODY) from None
    except (ValueError, RecursionError):
        got = "a number of thousands of digits, or brackets within brackets without end"
        raise UnreadableBody("body", expected="JSON that can be read", got=got, hint=BODY) from None


def _checked(model: type[M], values: Any, where: str) -> M:
    """A model of values; what is wrong with them is said with where they came: in the query or the body."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise RequestValidationError([{**first, "loc": (where, *first["loc"])}]) from None


@dataclass(frozen=True)
class Asked(Generic[M]):
    """A dependency that gives a model: of the parameters of a GET, or of the body of a POST (`both`).

    Args:
        model: what is asked. names: its fields that are parameters. needs: those that a GET must have.
    """

    model: type[M]
    names: tuple[str, ...]
    needs: tuple[str, ...] = ()

    async def __call__(self, request: Request, content: BodyBytes) -> M:
        limiter = request.app.state.deps.parsing
        if request.method == "POST":
            media = request.headers.get("content-type")
            return await anyio.to_thread.run_sync(_parsed, self.model, content, media, limiter=limiter)
        given = request.query_params
        fields = self.schema["properties"]
        values = {
            name: given.getlist(name) if fields[name].get("type") == "array" else given[name]
            for name in self.names
            if name in given
        }
        model = await anyio.to_thread.run_sync(_checked, self.model, values, "query", limiter=limiter)
        for name in self.needs:
            if name not in given:
                raise RequestValidationError([{"type": "missing", "loc": ("query", name), "msg": "", "input": None}])
        return model

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The fields as JSON schema has them."""
        return self.model.model_json_schema()

    def described(self) -> dict[str, Any]:
        """What OpenAPI tells of the parameters."""
        parameters = []
        for name in self.names:
            schema = {key: value for key, value in self.schema["properties"][name].items() if key != "description"}
            if "anyOf" in schema.get("items", {}):  # of an example, what a URL can hold
                schema["items"] = next(part for part in schema["items"]["anyOf"] if part["type"] == "string")
            about = self.schema["properties"][name].get("description", "")
            parameter = {"name": name, "in": "query", "required": name in self.needs, "schema": schema}
            parameters.append(parameter | {"description": about})
        return {"parameters": parameters}


def both(router: APIRouter, path: str, asked: Asked[Any], **route: Any) -> Callable[[F], F]:
    """Register an endpoint for a GET by parameters, and for a POST of the same as JSON."""

    def register(endpoint: F) -> F:
        answers = {"responses": route["responses"] | TAGGED} if "responses" in route else {}
        router.get(path, openapi_extra=asked.described(), **route | answers)(endpoint)
        router.post(path, openapi_extra=described_body(asked.model), **route)(endpoint)
        return endpoint

    return register


def _refused(kind: str, message: str, given: object) -> RequestValidationError:
    return RequestValidationError([{"type": kind, "loc": ("body",), "msg": message, "input": given}])


def _is_json(media: str | None) -> bool:
    message = email.message.Message()
    message["content-type"] = media or ""
    subtype = message.get_content_subtype()
    return message.get_content_maintype() == "application" and (subtype == "json" or subtype.endswith("+json"))


def described_body(model: type[BaseModel]) -> dict[str, Any]:
    """What OpenAPI tells of a route with a `json_body`."""
    _BODIES[model.__name__] = model
    schema = {"$ref": f"{SCHEMAS}{model.__name__}"}
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


def with_bodies(document: dict[str, Any]) -> dict[str, Any]:
    """An OpenAPI document with the schemas of the bodies that it refers to (`described_body`)."""
    components = document["components"]
    missing = set(re.findall(f"{SCHEMAS}(\\w+)", json.dumps(document))) - components["schemas"].keys()
    bodies: list[tuple[type[BaseModel], JsonSchemaMode]] = [(_BODIES[name], "validation") for name in sorted(missing)]
    _, found = models_json_schema(bodies, ref_template=SCHEMAS + "{model}")
    return {**document, "components": {**components, "schemas": found["$defs"] | components["schemas"]}}
