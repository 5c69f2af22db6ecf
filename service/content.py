"""Answers with an entity tag: files with ranges, pictures, and files that are made to be sent."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from fastapi import Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from liftcore.errors import NotFound
from service.errors import RangeNotSatisfiable
from service.problems import PROBLEM
from service.store.files import is_whole

ONE_RANGE = re.compile(r"bytes=\s*(?:(\d+)-(\d*)|-(\d+))\s*", re.ASCII)
MAX_DIGITS = 18  # longer numbers are beyond every file
BLOCK_BYTES = 256 << 10  # of a draft that is read and sent at a time
BYTES = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}

# For OpenAPI: what a route answers beside 200 when its answers have tags, and all that one that gives a file does.
TAGGED: dict[int | str, dict[str, Any]] = {304: {"description": "The client has it already (If-None-Match)"}}
FILE: dict[int | str, dict[str, Any]] = TAGGED | {
    200: {"description": "The whole of it", "content": BYTES},
    206: {"description": "The range that was asked for", "content": BYTES},
    416: {**PROBLEM, "description": "A range beyond the end"},
}


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
    same = unchanged(request, etag)
    if same is not None:
        return same
    return _FileAnswer(file, etag=etag, keep_range=_keeps_range(request, file.bytes, etag))


def draft_answer(draft: Path, *, filename: str, etag: str | None) -> Response:
    """A file that was made for this answer alone, to be saved under a name.

    The answer holds the file open, so its entry may go as soon as this returns; its room goes with the answer.
    """
    return Draft(draft.open("rb"), {"ETag": etag} if etag else {}, filename)


def _keeps_range(request: Request, size: int, etag: str) -> bool:
    """Whether the Range header counts: one range, well-formed, of the entity that the client thinks of."""
    header = request.headers.get("range", "")
    match = ONE_RANGE.fullmatch(header)
    if match is None or request.headers.get("if-range", etag) != etag:
        return False  # RFC 9110: what is not understood, or is of another version, is ignored
    first, last, suffix = match.groups()
    if first and last and _number(first) > _number(last):
        return False
    if (first and _number(first) >= size) or (suffix and _number(suffix) == 0):
        raise RangeNotSatisfiable("Range", expected=f"a range within {size} bytes", got=header[:80], size=size)
    return not any(len(digits or "") > MAX_DIGITS for digits in match.groups())


def _number(digits: str) -> int:
    return int(digits) if len(digits) <= MAX_DIGITS else 10**MAX_DIGITS


class _FileAnswer(FileResponse):
    """Starlette's file response with our entity tag, blind to Range headers that do not count."""

    def __init__(self, file: StoredFile, *, etag: str, keep_range: bool) -> None:
        headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
        super().__init__(file.path, headers=headers, filename=file.name, media_type="application/octet-stream")
        self._keep_range = keep_range

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not self._keep_range:
            headers = [pair for pair in scope["headers"] if pair[0] not in (b"range", b"if-range")]
            scope = {**scope, "headers": headers}
        await super().__call__(scope, receive, send)


class Draft(StreamingResponse):
    """An open file, read in blocks by threads of the pool, and closed however the answer ends."""

    def __init__(self, file: BinaryIO, headers: dict[str, str], filename: str) -> None:
        headers |= {
            "Content-Length": str(os.fstat(file.fileno()).st_size),
            "Content-Disposition": f'attachment; filename="{filename}"',
            "Cache-Control": "private, no-cache",
        }
        super().__init__(iter(lambda: file.read(BLOCK_BYTES), b""), 200, headers, "application/octet-stream")
        self.file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self.file.close()
