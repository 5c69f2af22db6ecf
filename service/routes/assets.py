"""/assets: uploads."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path as FilePath
from typing import Annotated

import anyio
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse

from service import wire
from service.content import FILE, StoredFile, file_answer
from service.errors import DigestMismatch
from service.parts import Here
from service.store.assets import AssetRecord, CheckedUpload
from service.store.files import DataDirectory
from service.store.store import Store
from service.uploads.checking import CheckLimits, check
from service.uploads.decoding import coding_of
from service.uploads.intake import Intake, require_size

BATCH = 1 << 20  # bytes gathered before a thread writes them
MAX_DIGITS = 20  # of a Content-Length: h11 takes no more

router = APIRouter(prefix="/assets", tags=["assets"])
# By the name of the other routes' part: to OpenAPI, two templates that match the same paths are one path twice.
Kind = Annotated[wire.AssetKind, Path(alias="asset", description="what it is")]
AssetId = Annotated[str, Path(description="sha256: and the digest of the bytes, in hex")]
Sha256 = Annotated[
    str | None,
    Query(pattern="^[0-9a-fA-F]{64}$", description="of the content after decompression; checked if given"),
]
RAW_BODY = {
    "requestBody": {
        "required": True,
        "description": "the file itself, with Content-Encoding: gzip or zstd if it is compressed",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.put(
    "/{asset}",
    response_model=wire.Asset,
    status_code=201,
    responses={200: {"model": wire.Asset, "description": "It was here already"}},
    openapi_extra=RAW_BODY,
)
async def upload(kind: Kind, request: Request, here: Here, sha256: Sha256 = None) -> Response:
    """Upload splats (PLY), cameras (JSON or a zip of a COLMAP model), a feature pack, masks or a text table."""
    coding = coding_of(", ".join(request.headers.getlist("content-encoding")))
    limit = here.settings.max_upload_bytes(kind)
    require_size(kind, _announced(request), limit)  # before a byte of it is asked for with 100 Continue
    here.store.files.require_room()
    await anyio.to_thread.run_sync(here.store.assets.require_quota)
    async with _workspace(here.store.files, kind) as (draft, scratch):
        with Intake(draft, kind, limit=limit, coding=coding, permit=_permit(here.store)) as intake:
            await _receive(request, intake)
            digest = intake.finish()
        if sha256 is not None and digest != sha256.lower():
            raise DigestMismatch("sha256", expected=sha256, got=digest, hint="upload the file again")
        known = await anyio.to_thread.run_sync(here.store.assets.find, f"sha256:{digest}")
        if known is not None and known.kind is kind and known.whole:
            return _reply(known, 200)
        allowed = here.settings
        limits = CheckLimits(scratch, allowed.check_seconds, allowed.check_memory_bytes, here.ending)
        report = await anyio.to_thread.run_sync(check, kind, draft, limits, limiter=here.checks)
        checked = CheckedUpload(draft, kind, digest, report.suffix, report.counts, report.warnings)
        asset, new = await anyio.to_thread.run_sync(here.store.assets.add, checked)
    return _reply(asset, 201 if new else 200)


def _announced(request: Request) -> int:
    """The bytes that a body is said to have, 0 when nothing is said."""
    length = request.headers.get("content-length", "")
    return int(length[:MAX_DIGITS]) if length.isascii() and length.isdigit() else 0


@asynccontextmanager
async def _workspace(files: DataDirectory, kind: wire.AssetKind) -> AsyncIterator[tuple[FilePath, FilePath]]:
    """A draft and a folder for one upload; both go in a thread, as removing gigabytes takes its time."""
    stack = ExitStack()
    try:
        yield stack.enter_context(files.draft(f".{kind}")), stack.enter_context(files.scratch())
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(stack.close)


def _permit(store: Store) -> Callable[[int, int], None]:
    """Looks at the disk and the owner's quota while content comes: compressed, its end is not known before."""

    def permit(whole: int, coming: int) -> None:
        store.files.require_room(coming)
        store.assets.require_quota(whole)

    return permit


async def _receive(request: Request, intake: Intake) -> None:
    batch = bytearray()
    async for chunk in request.stream():
        batch += chunk
        if len(batch) >= BATCH:
            await anyio.to_thread.run_sync(intake.feed, bytes(batch))
            batch.clear()
    await anyio.to_thread.run_sync(intake.feed, bytes(batch))


@router.get("", response_model=wire.Assets)
def list_assets(here: Here) -> wire.Assets:
    """All assets, newest first. Lists of names and words are told with each asset alone."""
    return wire.Assets(assets=[shape(asset) for asset in here.store.assets.all()])


@router.get("/{asset}", response_model=wire.Asset)
def get_asset(asset: AssetId, here: Here) -> wire.Asset:
    """One asset."""
    return shape(here.store.assets.get(asset))


@router.get("/{asset}/content", response_class=Response, responses=FILE)
def get_content(asset: AssetId, request: Request, here: Here) -> Response:
    """The bytes of an asset, or a range of them."""
    found = here.store.assets.get(asset)
    digest = found.id.removeprefix("sha256:")
    return file_answer(request, StoredFile(found.path, found.bytes, digest, found.file_name))


@router.delete("/{asset}", status_code=204)
def delete_asset(asset: AssetId, here: Here) -> None:
    """Forget an asset that no job and no lift refers to."""
    here.store.assets.delete(asset)


def shape(asset: AssetRecord) -> wire.Asset:
    """An asset as the wire has it."""
    return wire.Asset(
        id=asset.id,
        kind=asset.kind,
        bytes=asset.bytes,
        counts=asset.counts,
        warnings=asset.warnings,
        created=asset.created,
        links={"self": f"/assets/{asset.id}", "content": f"/assets/{asset.id}/content"},
    )


def _reply(asset: AssetRecord, status: int) -> Response:
    location = {"Location": f"/assets/{asset.id}"}
    return JSONResponse(shape(asset).model_dump(mode="json"), status, headers=location)
