"""/assets: uploads."""

from __future__ import annotations

import hashlib
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter

from service.errors import MalformedRequest, TooLarge, UnsupportedMedia
from service.models import Asset, AssetKind
from service.routes import BINARY, Caller, Deps, Parts, add_list, content_of, file_answer

BATCH = 1 << 20  # bytes that are collected before a thread writes them
CHECK_BASE_BYTES, CHECK_FACTOR = 1 << 30, 16  # memory of a check: a reader holds several copies of a file
UPLOAD: dict[str, Any] = {
    "max_body_size": 1 << 62,  # the limit is a setting
    "openapi_extra": {
        "requestBody": {
            "required": True,
            "description": "the file itself",
            "content": {BINARY: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
}
REFUSED_HEADERS = {
    "Content-Encoding": ("(?!identity$).+", UnsupportedMedia),
    "Content-Type": ("multipart/.*", UnsupportedMedia),
    "Content-Range": (".+", MalformedRequest),  # RFC 9110, 14.5: whoever takes no parts of PUT refuses them
}
# OpenAPI takes two templates of the same paths as one path given twice, so the parameter has one name.
Kind = Annotated[AssetKind, PathParameter(alias="asset", description="its kind")]
REPEATED: dict[int | str, dict[str, Any]] = {200: {"model": Asset, "description": "It was here already"}}

router = APIRouter(tags=["assets"])
add_list(router, "assets", Asset, Asset.model_validate)


@router.put("/assets/{asset}", status_code=201, responses=REPEATED, **UPLOAD)
async def put_asset(kind: Kind, request: Request, response: Response, deps: Deps, owner: Caller) -> Asset:
    """Upload a file. The service checks it whole.

    It is splats (any format but checkpoints), cameras (JSON, or a zip of a COLMAP model or of several files), a
    feature pack, masks, a text table, or photos (a zip of JPEG and PNG files that are named like the views).
    """
    async with receive_upload(request, deps) as (draft, digest):
        asset = await in_thread(deps, deps.store.find_asset, owner, f"sha256:{digest}")
        if asset is not None and asset.kind == kind and asset.file.exists():
            response.status_code = 200
        else:
            content = await check_upload(deps, kind, draft)
            asset = await in_thread(deps, deps.store.add_asset, owner, kind, draft, digest, content)
    response.headers["Location"] = f"/assets/{asset.id}"
    return asset


async def in_thread(deps: Parts, call: Any, *arguments: Any) -> Any:
    """Return the result of a call that reads or writes files, in a thread for uploads."""
    return await anyio.to_thread.run_sync(call, *arguments, limiter=deps.writing)


@asynccontextmanager
async def receive_upload(request: Request, deps: Parts) -> AsyncIterator[tuple[Path, str]]:
    """Receive a body into a draft; yield that and its sha256 in hex. The draft is removed at the end of the block."""
    require_file(request)
    limit, digest, count, batch = deps.settings.upload_bytes, hashlib.sha256(), 0, bytearray()
    scratch = deps.store.scratch()
    draft = await in_thread(deps, scratch.__enter__) / "upload"

    def write(content: bytes) -> None:
        deps.store.require_room(len(content))
        digest.update(content)
        with draft.open("ab") as file:
            file.write(content)

    try:
        async for chunk in request.stream():
            batch += chunk
            count += len(chunk)
            if count > limit:
                raise TooLarge("body", expected=f"at most {limit} bytes", got="more")
            if len(batch) >= BATCH:
                await in_thread(deps, write, bytes(batch))
                batch.clear()
        await in_thread(deps, write, bytes(batch))
        yield draft, digest.hexdigest()
    finally:
        with anyio.CancelScope(shield=True):  # removing gigabytes takes long
            await in_thread(deps, scratch.__exit__, None, None, None)


def require_file(request: Request) -> None:
    """Require that a body is a plain and whole file: neither compressed, nor a part of a form or of a file."""
    for name, (refused, error) in REFUSED_HEADERS.items():
        value = ", ".join(request.headers.getlist(name)).strip()
        if re.fullmatch(refused, value, re.IGNORECASE | re.DOTALL):
            hint = "send it in one request, with curl -T FILE; .spz and .sog are compressed already"
            raise error(name, expected="the file itself, plain and whole, as the body", got=value[:80], hint=hint)


async def check_upload(deps: Parts, kind: str, draft: Path, cameras: Asset | None = None) -> dict[str, Any]:
    """Check a file in a child, a lift with other cameras; return what its task returns."""
    size, settings = draft.stat().st_size + (cameras.bytes if cameras else 0), deps.settings
    order = {
        "task": "check", "kind": kind, "file": str(draft), "scratch": str(draft.parent),
        "memory": min(settings.check_memory_bytes, CHECK_BASE_BYTES + CHECK_FACTOR * size),
        "names": {str(draft): kind, f"text table {draft.name}": kind},
    }  # fmt: skip
    if cameras is not None:
        order |= {"cameras": str(cameras.file)}
        order["names"][str(cameras.file)] = cameras.client_name
    result_of = deps.children.result_of
    return await anyio.to_thread.run_sync(result_of, order, settings.check_seconds, kind, limiter=deps.checks)


@router.get("/assets/{asset}")
def get_asset(asset: str, deps: Deps, owner: Caller) -> Asset:
    """Get one asset, with the names of its views or its words if they are not very many."""
    return deps.store.asset(owner, asset)


@router.get("/assets/{asset}/content", response_class=Response, responses=content_of(BINARY))
def get_asset_content(asset: str, request: Request, deps: Deps, owner: Caller) -> Response:
    """Download an asset, or a range of its bytes."""
    record = deps.store.asset(owner, asset)
    digest = record.id.removeprefix("sha256:")
    return file_answer(request, record.file, record.bytes, digest, record.download_name)


@router.delete("/assets/{asset}", status_code=204)
def delete_asset(asset: str, deps: Deps, owner: Caller) -> None:
    """Delete an asset. Refused (409) while a job or a lift refers to it."""
    deps.store.delete_asset(owner, asset)
