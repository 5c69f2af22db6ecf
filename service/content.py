"""Answers other than plain JSON: files with ranges and entity tags, drafts, long lists, and events."""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import anyio
from fastapi import Query, Request
from fastapi.responses import Response, StreamingResponse
from fastapi.sse import EventSourceResponse, format_sse_event
from pydantic import BaseModel
from starlette.types import Receive, Scope, Send

from liftcore.errors import NotFound
from service import models
from service.errors import RangeNotSatisfiable, ServiceUnavailable, require_share
from service.models import FINAL_STATES
from service.problems import PROBLEM
from service.store.database import CURSOR, Page
from service.store.files import require_whole
from service.store.jobs import Event, EventKind

BLOCK_BYTES = 256 << 10  # of a draft that is read and sent at a time
STREAMED_RECORDS = 50  # records of a list in memory at a time: those of a job with 10,000 packs take 700 KB
FAR_DIGITS = 20  # of a number beyond every file; int() refuses numbers of thousands of digits
RANGE = re.compile(r"\s*bytes\s*=\s*(\d*)\s*-\s*(\d{0,19})\s*", re.ASCII | re.IGNORECASE)
BINARY = "application/octet-stream"
BYTES = {BINARY: {"schema": {"type": "string", "format": "binary"}}}

# For OpenAPI: the statuses beside 200 of answers with entity tags, and of answers that are files.
TAGGED: dict[int | str, dict[str, Any]] = {304: {"description": "The client has it already (If-None-Match)"}}
FILE: dict[int | str, dict[str, Any]] = TAGGED | {
    200: {"description": "The whole of it", "content": BYTES},
    206: {"description": "The requested range", "content": BYTES},
    416: {**PROBLEM, "description": "A range beyond the end"},
}

Limit = Annotated[int, Query(ge=1, le=models.PAGE, description="number of items to list")]
Cursor = Annotated[str | None, Query(pattern=CURSOR, description="the `next` of the page before")]


def unchanged(request: Request, etag: str, *, exists: bool = True) -> Response | None:
    """Return 304 if the client already has this entity, else None.

    Args:
        request: with an If-None-Match, or without.
        etag: of the entity.
        exists: True if the entity is known to exist; ``*`` matches any that does.
    """
    header = request.headers.get("if-none-match")
    if header is None:
        return None
    tags = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    is_same = etag in tags or (exists and "*" in tags)
    return Response(status_code=304, headers={"ETag": etag}) if is_same else None


def cache_headers(etag: str) -> dict[str, str]:
    """Return the headers of an answer that clients may keep but must revalidate."""
    return {"ETag": etag, "Cache-Control": "private, no-cache"}


def file_answer(
    request: Request, path: Path, size: int, sha256: str, name: str, header: bytes | None = None
) -> Response:
    """Return a stored file, whose bytes never change: 200, 206 for one range, 304 if the client has it.

    Args:
        path: of the file. size: in bytes, when it was stored. sha256: of the bytes. name: for who saves it.
        header: of a safetensors file, what the answer begins with in place of the file's own length and header.

    Raises:
        RangeNotSatisfiable: the range begins beyond the end.
        NotFound: the file is not there, or no longer what was stored.
    """
    require_whole(path, size)
    stored, offset = size, 0
    if header is not None:
        with path.open("rb") as handle:
            offset = 8 + int.from_bytes(handle.read(8), "little")
        size += len(header) - offset
        sha256 = hashlib.sha256(header + sha256.encode()).hexdigest()
    etag = f'"{sha256}"'
    if (not_modified := unchanged(request, etag)) is not None:
        return not_modified
    range_header, condition = request.headers.get("range"), request.headers.get("if-range", etag)
    part = _range_of(range_header, size) if range_header is not None and condition == etag else None
    try:
        return _FilePart(path, header or b"", offset, part, size, cache_headers(etag) | _saved_as(name))
    except FileNotFoundError:  # deleted in the meantime
        require_whole(path, stored)
        raise


def _range_of(header: str, size: int) -> tuple[int, int] | None:
    """Return the first and the last byte of a Range header; None for several or malformed ones (RFC 9110, 14.2).

    Raises:
        RangeNotSatisfiable: it begins beyond the end.
    """
    match = RANGE.fullmatch(header)
    if match is None or not any(match.groups()):
        return None
    first, last = match[1].lstrip("0") or match[1][:1], int(match[2] or size)
    begin = max(0, size - last) if not first else int(first) if len(first) < FAR_DIGITS else size
    if begin >= size:
        expected, headers = f"a range within {size} bytes", {"Content-Range": f"bytes */{size}"}
        raise RangeNotSatisfiable("Range", expected=expected, got=header[:80], headers=headers)
    last = min(last, size - 1) if first else size - 1
    return (begin, last) if begin <= last else None


class _OpenFile(StreamingResponse):
    """Answer from a file, which is closed after the answer."""

    file: BinaryIO

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self.file.close)  # closing a draft of gigabytes may block


class _FilePart(_OpenFile):
    """Answer with a header and the bytes behind an offset of a file, or with a range of these."""

    def __init__(
        self, path: Path, header: bytes, offset: int, part: tuple[int, int] | None, size: int, headers: dict[str, str]
    ) -> None:
        first, last = part or (0, size - 1)
        own_headers = {"Content-Length": str(last + 1 - first), "Accept-Ranges": "bytes"}
        own_headers |= {"Content-Range": f"bytes {first}-{last}/{size}"} if part else {}
        self.file = path.open("rb")
        blocks = self._blocks(header, offset, first, last + 1)
        super().__init__(blocks, 206 if part else 200, own_headers | headers, BINARY)

    def _blocks(self, header: bytes, offset: int, first: int, end: int) -> Iterator[bytes]:
        yield header[first:end]
        first = max(first, len(header))
        self.file.seek(first - len(header) + offset)
        while first < end and (block := self.file.read(min(BLOCK_BYTES, end - first))):
            first += len(block)
            yield block


class Draft(_OpenFile):
    """Answer from a temporary file, which may be saved under a name.

    It is held open, so its entry may go as soon as this is made; its room goes with the answer, however that ends.
    """

    def __init__(self, draft: Path, media_type: str, *, filename: str | None, headers: Mapping[str, str]) -> None:
        self.file = draft.open("rb")
        own_headers = {
            "Content-Length": str(os.fstat(self.file.fileno()).st_size),
            "Cache-Control": "private, no-cache",
        }
        own_headers |= {} if filename is None else _saved_as(filename)
        super().__init__(iter(lambda: self.file.read(BLOCK_BYTES), b""), 200, own_headers | dict(headers), media_type)


def _saved_as(name: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{name}"'}


def page_response(
    name: str,
    page: Callable[[int, str | None], Page[Any]],
    shape: Callable[[Any], BaseModel],
    *,
    limit: int,
    cursor: str | None,
) -> Response:
    """Return a page of a list, newest first, as a stream, so that no page is in memory whole.

    Args:
        name: of the list in the JSON object; ``next`` beside it is the cursor of the next page, or null.
        page: returns so many records after a cursor.
        shape: converts a record to the model that clients get.
        limit, cursor: of the request.
    """
    first = page(min(limit, STREAMED_RECORDS), cursor)  # before the answer begins: the cursor may be invalid

    def pieces() -> Iterator[str]:
        page_records, remaining = first, limit
        yield f'{{"{name}":['
        while True:
            yield ",".join(shape(record).model_dump_json() for record in page_records.records)
            remaining -= len(page_records.records)
            if page_records.cursor is None or remaining == 0:
                break
            page_records = page(min(remaining, STREAMED_RECORDS), page_records.cursor)
            yield "," if page_records.records else ""
        yield f'],"next":{json.dumps(page_records.cursor)}}}'

    return StreamingResponse(pieces(), media_type="application/json")


# Events of a job as a stream (server-sent events), for a limited number of clients at a time

POLL_SECONDS = 0.25  # between polls for new events
KEEPALIVE_SECONDS = 15.0  # of silence, then a comment keeps the connection open
POLL_THREADS = 2  # threads for polls of all streams, so that these do not starve other routes

EventSource = Callable[[int], list[Event]]  # returns the events after a number
Shape = Callable[[Event], str]  # returns the JSON of an event


class EventStreams:
    """Open streams, with a limit for each key. Used from the event loop only.

    Args:
        limit: their maximum number.
        of_a_key: the maximum number for one key, below the limit.
    """

    def __init__(self, limit: int, of_a_key: int) -> None:
        self._limit = limit
        self._share = max(1, min(of_a_key, limit - 1))
        self._closing = False
        self._poll_threads = anyio.CapacityLimiter(POLL_THREADS)
        self._open: Counter[str | None] = Counter()

    @property
    def open(self) -> int:
        """Number of open streams."""
        return self._open.total()

    def close(self) -> None:
        """End every stream soon: the server stops."""
        self._closing = True

    def answer(self, source: EventSource, shape: Shape, after: int, key: str | None) -> EventSourceResponse:
        """Return the events after a number as they come, until the last state.

        Raises:
            ServiceUnavailable: as many streams are open as may be.
            KeyLimitReached: the key has its share of them.
        """
        if self.open >= self._limit:
            raise ServiceUnavailable(
                "events", expected=f"at most {self._limit} open streams", got="more", hint="GET the job instead"
            )
        require_share("events", self._open[key], None if key is None else self._share)
        return _Stream(self._open, key, self._follow(source, shape, after))

    async def _follow(self, source: EventSource, shape: Shape, after: int) -> AsyncIterator[bytes]:
        spoke = time.monotonic()
        while not self._closing:
            try:
                events = await anyio.to_thread.run_sync(source, after, limiter=self._poll_threads)
            except NotFound:  # deleted meanwhile, or the key was revoked
                return
            for event in events:
                after, spoke = event.number, time.monotonic()
                yield format_sse_event(id=str(event.number), event=event.kind, data_str=shape(event))
                if is_last(event):
                    return
            if time.monotonic() - spoke > KEEPALIVE_SECONDS:
                spoke = time.monotonic()
                yield format_sse_event(comment="still here")
            await anyio.sleep(POLL_SECONDS)


def is_last(event: Event) -> bool:
    """Return True if no event follows this one."""
    return event.kind is EventKind.STATE and event.data["state"] in FINAL_STATES


class _Stream(EventSourceResponse):
    """Stream that counts as open while it is sent."""

    def __init__(self, count: Counter[str | None], key: str | None, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._count, self._key = count, key
        count[key] += 1

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._count[self._key] -= 1
            if not self._count[self._key]:
                del self._count[self._key]
