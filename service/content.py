"""Answers beside plain JSON: files with ranges and entity tags, pictures, drafts, and long lists."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import anyio
from fastapi import Query, Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from pydantic import BaseModel
from starlette import responses
from starlette.types import Receive, Scope, Send

from liftcore.errors import NotFound
from service.errors import RangeNotSatisfiable
from service.problems import PROBLEM
from service.store.database import CURSOR, Page
from service.store.files import is_whole

BLOCK_BYTES = 256 << 10  # of a draft that is read and sent at a time
STREAMED = 200  # records of a long list that are in memory at a time
FAR_BEGINNING = re.compile(r"(=\s*)0*[1-9]\d{19,}(?=\s*-)", re.ASCII)  # int() takes no number of thousands of digits
BINARY = "application/octet-stream"
BYTES = {BINARY: {"schema": {"type": "string", "format": "binary"}}}

# For OpenAPI: what a route answers beside 200 when its answers have tags, and all that one that gives a file does.
TAGGED: dict[int | str, dict[str, Any]] = {304: {"description": "The client has it already (If-None-Match)"}}
FILE: dict[int | str, dict[str, Any]] = TAGGED | {
    200: {"description": "The whole of it", "content": BYTES},
    206: {"description": "The range that was asked for", "content": BYTES},
    416: {**PROBLEM, "description": "A range beyond the end"},
}

Limit = Annotated[
    int | None, Query(ge=1, le=1000, description="how many to list; left out, all of them are, in one long answer")
]
Cursor = Annotated[str | None, Query(pattern=CURSOR, description="the `next` of the page before")]


def unchanged(request: Request, etag: str, *, found: bool = True) -> Response | None:
    """304 when the client has this entity already, else None.

    Args:
        request: what may have an If-None-Match.
        etag: of the entity.
        found: whether it is known to exist; ``*`` means any entity that does.
    """
    header = request.headers.get("if-none-match")
    if header is None:
        return None
    tags = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    same = etag in tags or (found and "*" in tags)
    return Response(status_code=304, headers={"ETag": etag}) if same else None


def tagged(content: bytes, media_type: str, etag: str) -> Response:
    """Content that a client may keep and must ask about."""
    return Response(content, media_type=media_type, headers={"ETag": etag, "Cache-Control": "private, no-cache"})


@dataclass(frozen=True)
class StoredFile:
    """A file whose bytes never change."""

    path: Path
    bytes: int  # when it was stored
    sha256: str
    name: str  # for who saves it


def file_answer(request: Request, file: StoredFile) -> Response:
    """The file: 200, 206 for one range, 304 when the client has it.

    Raises:
        RangeNotSatisfiable: the range begins beyond the end.
        NotFound: the file is not there, or no longer what was stored.
    """
    etag = f'"{file.sha256}"'
    if not is_whole(file.path, file.bytes):
        there = "one of another size" if file.path.exists() else "none"
        raise NotFound(
            "content", expected=f"a file of {file.bytes} bytes in the data directory", got=there,
            hint="it was deleted a moment ago, or something else wrote there: upload it again, or lift again",
        )  # fmt: skip
    headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
    return unchanged(request, etag) or _FileAnswer(file.path, headers=headers, filename=file.name, media_type=BINARY)


class _FileAnswer(FileResponse):
    """Starlette's, but that a range which it does not understand is as none, as RFC 9110 has it."""

    @classmethod
    def _parse_range_header(cls, http_range: str, file_size: int) -> list[tuple[int, int]]:
        try:
            ranges = super()._parse_range_header(FAR_BEGINNING.sub(r"\g<1>" + "9" * 19, http_range), file_size)
        except responses.MalformedRangeHeader:
            return []
        except responses.RangeNotSatisfiable:
            expected = f"a range within {file_size} bytes"
            raise RangeNotSatisfiable("Range", expected=expected, got=http_range[:80], size=file_size) from None
        return ranges if len(ranges) == 1 else []


class Draft(StreamingResponse):
    """A file that was made for this answer alone, to be saved under a name.

    It is held open, so its entry may go as soon as this is made; its room goes with the answer, however that ends.
    """

    def __init__(self, draft: Path, *, filename: str, etag: str | None) -> None:
        self.file: BinaryIO = draft.open("rb")
        headers = {
            "Content-Length": str(os.fstat(self.file.fileno()).st_size),
            "Content-Disposition": f'attachment; filename="{filename}"',
            "Cache-Control": "private, no-cache",
        } | ({"ETag": etag} if etag else {})
        super().__init__(iter(lambda: self.file.read(BLOCK_BYTES), b""), 200, headers, BINARY)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self.file.close)  # gigabytes take their time to go


def listed(
    name: str,
    page: Callable[[int, str | None], Page[Any]],
    shape: Callable[[Any], BaseModel],
    *,
    limit: int | None,
    cursor: str | None,
) -> Response:
    """A list, newest first: one page of it with ``next``, the cursor of the page after it or null; or, without a
    limit, all that follows, streamed, so that no list is ever in memory whole.

    Args:
        name: of the list in the JSON object.
        page: so many records after a cursor.
        shape: a record as clients get it.
        limit, cursor: as the client gave them.
    """
    first = page(limit or STREAMED, cursor)
    if limit is not None:
        following = "null" if first.cursor is None else f'"{first.cursor}"'
        body = f'{{"{name}":[{_joined(first, shape)}],"next":{following}}}'
        return Response(body, media_type="application/json")

    def pieces() -> Iterator[str]:
        yield f'{{"{name}":[{_joined(first, shape)}'
        following = first.cursor
        while following is not None:
            found = page(STREAMED, following)
            following = found.cursor
            yield f",{_joined(found, shape)}" if found.records else ""
        yield "]}"

    if first.cursor is None:
        return Response("".join(pieces()), media_type="application/json")
    return StreamingResponse(pieces(), media_type="application/json")


def _joined(page: Page[Any], shape: Callable[[Any], BaseModel]) -> str:
    return ",".join(shape(record).model_dump_json() for record in page.records)
