"""The routes: thin calls of the store, the children and the query process. Here what they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, TypeVar

import anyio
from fastapi import APIRouter, Body, Depends, Query, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, create_model
from starlette.convertors import Convertor

from service.models import CURSOR, PAGE, Key, Next
from service.process import Children
from service.query_client import QueryClient
from service.runner import Runner
from service.settings import ServiceSettings
from service.store import Owner, Store, require_whole

BINARY = "application/octet-stream"
Limit = Annotated[int, Query(ge=1, le=PAGE, description="number of items to list")]
Cursor = Annotated[str | None, Query(pattern=CURSOR, description="the `next` of the page before")]
Number = Annotated[int, Query(ge=0, le=10**9)]
Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


class OneOf(Convertor[str]):
    """The part of a path that is one of some names; others are no such route."""

    def __init__(self, *names: str) -> None:
        vars(self)["regex"] = "|".join(names)

    def convert(self, value: str) -> str:
        """Return the name."""
        return value

    to_string = convert


@dataclass(frozen=True)
class Parts:
    """The parts of the application."""

    settings: ServiceSettings
    store: Store
    children: Children
    runner: Runner
    queries: QueryClient
    checks: anyio.CapacityLimiter  # uploads and plans that are checked at the same time
    writing: anyio.CapacityLimiter  # uploads that are written: a stalled disk blocks them and no other route


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _parts(request: Request) -> Parts:
    return request.app.state.parts


async def _owner(request: Request) -> Owner:
    return request.scope["state"]["owner"]


async def _key(request: Request) -> Key | None:
    return request.scope["state"]["key"]


Deps = Annotated[Parts, Depends(_parts)]
Caller = Annotated[Owner, Depends(_owner)]  # whose records count
CallerKey = Annotated[Key | None, Depends(_key)]


def content_of(*media_types: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of an answer that is a file; the client may have it already."""
    content = {name: {"schema": {"type": "string", "format": "binary"}} for name in media_types}
    return {200: {"description": "The file", "content": content}, 304: {"description": "As in If-None-Match"}}


def cache_headers(etag: str) -> dict[str, str]:
    """Return the headers of an answer that clients may keep but must revalidate."""
    return {"ETag": etag, "Cache-Control": "private, no-cache"}


def unchanged(request: Request, etag: str, *, exists: bool = True) -> Response | None:
    """Return 304 if the client already has this entity, else None; ``*`` matches any that is known to exist."""
    tags = {tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")}
    is_same = etag in tags or (exists and "*" in tags)
    return Response(status_code=304, headers={"ETag": etag}) if is_same else None


def file_answer(request: Request, file: Path, size: int, sha256: str, name: str) -> Response:
    """Return a stored file, whose bytes never change, or a range of it."""
    require_whole(file, size)
    etag = f'"{sha256}"'
    headers = cache_headers(etag)
    return unchanged(request, etag) or FileResponse(file, headers=headers, media_type=BINARY, filename=name)


def add_list(
    router: APIRouter, table: str, model: type[BaseModel], record_of: Callable[[dict[str, Any]], BaseModel]
) -> None:
    """Register the route that lists the records of a table."""
    fields: dict[str, Any] = {table: (list[model], ...), "next": (Next, ...)}
    page = create_model(table.capitalize(), __doc__=f"Some of the {table}.", **fields)

    @router.get(
        f"/{table}", name=f"list_{table}", response_model=page, description=f"List the {table}, newest first."
    )
    def list_records(deps: Deps, owner: Caller, limit: Limit = PAGE, cursor: Cursor = None) -> dict[str, Any]:
        rows, following = deps.store.page(table, owner, limit, cursor)
        return {table: [record_of(row) for row in rows], "next": following}


def get_and_post(
    router: APIRouter, path: str, parameters: type[BaseModel], body: type[BaseModel], **route: Any
) -> Callable[[Endpoint], Endpoint]:
    """Register an endpoint with an argument ``question`` for GET, by its query, and for POST, by its JSON body."""

    def register(endpoint: Endpoint) -> Endpoint:
        for model, source, add, suffix in (
            (parameters, Query(), router.get, ""),
            (body, Body(), router.post, "_by_body"),
        ):

            @wraps(endpoint)
            def handle(**arguments: Any) -> Any:
                return endpoint(**arguments)

            own_signature = signature(endpoint, eval_str=True)
            annotation = Annotated[model, source]
            fields = [
                field.replace(annotation=annotation) if field.name == "question" else field
                for field in own_signature.parameters.values()
            ]
            handle.__signature__ = own_signature.replace(parameters=fields)  # pyright: ignore[reportAttributeAccessIssue]
            add(path, name=f"{endpoint.__name__}{suffix}", **route)(handle)
        return endpoint

    return register
