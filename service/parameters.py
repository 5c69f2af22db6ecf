"""Query parameters that a route does not know are refused: passed over, they would seem to have been heard."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Depends, Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel

from service.errors import InvalidRequest
from service.fields import NAME_CHARACTERS, one_of


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _known_only(request: Request) -> None:
    given = request.query_params
    if not given:
        return
    route: APIRoute = request.scope["route"]
    known = list(_names(route.dependant))
    for name in given:
        if name not in known:
            raise InvalidRequest(
                name[:NAME_CHARACTERS], expected=one_of(known) if known else "no parameters",
                got=repr(name[:NAME_CHARACTERS]), hint="in the query of the request",
            )  # fmt: skip


KnownParameters = Depends(_known_only)


def _names(route: Dependant) -> Iterator[str]:
    """The query parameters that a route declares, one by one or as the fields of a model."""
    for field in route.query_params:
        declared = field.field_info.annotation
        if isinstance(declared, type) and issubclass(declared, BaseModel):
            yield from declared.model_fields
        else:
            yield field.alias
