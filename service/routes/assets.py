"""/assets: uploads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Annotated, Any, TypeVar

import anyio
from fastapi import APIRouter, Path, Query, Request, Response

from service import models
from service.child import error_of
from service.content import FILE, Cursor, Limit, file_answer, page_response
from service.errors import ProcessDied
from service.requests import JsonRoute, require_file
from service.sandbox import run_sandboxed
from service.state import AppState, Deps
from service.store.assets import SHOWN_CHARACTERS, AssetRecord
from service.store.files import require_whole
from service.uploads import AssetIntake, Intake, Record, require_size, too_slow

T = TypeVar("T")
BATCH = 1 << 20  # bytes that are collected before a thread writes them
HEADER_LENGTH_BYTES = 8  # length field at the begin of a safetensors file
MAX_DIGITS = 20  # of a Content-Length: h11 accepts no more

router = APIRouter(prefix="/assets", tags=["assets"], route_class=JsonRoute)
# OpenAPI takes two templates of the same paths as one path given twice, so the parameter has one name.
AssetKind = Annotated[models.AssetKind, Path(alias="asset", description="its kind")]
KindParameter = Annotated[models.AssetKind, Query(description="its kind")]
AssetId = Annotated[str, Path(description="sha256: and the digest of the bytes, in hex")]
Sha256 = Annotated[str | None, Query(pattern="^[0-9a-fA-F]{64}$", description="of the content; checked if given")]
NamesCursor = Annotated[int, Query(ge=0, le=10**9, description="the `next` of the page before")]
KNOWN_ALREADY: dict[int | str, dict[str, Any]] = {200: {"model": models.Asset, "description": "It was here already"}}
RAW_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "the file itself",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.put("/{asset}", response_model=models.Asset, status_code=201, responses=KNOWN_ALREADY, openapi_extra=RAW_BODY)
async def put_asset(kind: AssetKind, request: Request, deps: Deps, sha256: Sha256 = None) -> Response:
    """Upload a file. The service checks it whole.

    It is splats (any format but checkpoints), cameras (JSON, or a zip of a COLMAP model or of several files), a
    feature pack, masks, a text table, or photos (a zip of JPEG and PNG files that are named like the views).
    """
    asset, new = await receive_upload(AssetIntake, kind, request, deps, sha256)
    return _reply(asset, 201 if new else 200)


@router.post("", response_model=models.Asset, status_code=201, responses=KNOWN_ALREADY, openapi_extra=RAW_BODY)
async def create_asset(kind: KindParameter, request: Request, deps: Deps, sha256: Sha256 = None) -> Response:
    """Upload a file, as PUT does."""
    return await put_asset(kind, request, deps, sha256)


async def receive_upload(
    into: Callable[..., Intake[Record]], kind: models.UploadKind, request: Request, deps: AppState, sha256: str | None
) -> tuple[Record, bool]:
    """Receive, check and store an upload; return True if its owner did not have it before."""
    require_file(request.headers)
    limit = deps.settings.max_upload_bytes(kind)
    require_size(kind, _declared_size(request), limit)  # before 100 Continue invites the body
    intake = into(deps.store, deps.owner, kind, limit)

    async def write(step: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(step, *arguments, limiter=deps.writing)

    try:
        await write(intake.open)
        await _receive(request, partial(write, intake.feed))
        existing = await write(intake.finish, sha256)
        if existing is not None:
            return existing, False
        upload = await anyio.to_thread.run_sync(intake.check, deps.check_limits, limiter=deps.checks)
        return await write(intake.keep, upload)
    finally:
        with anyio.CancelScope(shield=True):  # removing gigabytes takes long
            await write(intake.close)


def _declared_size(request: Request) -> int:
    """Return the declared length of a body in bytes; 0 if there is none."""
    length = request.headers.get("content-length", "")
    return int(length[:MAX_DIGITS]) if length.isascii() and length.isdigit() else 0


async def _receive(request: Request, feed: Callable[[bytes], Any]) -> None:
    batch = bytearray()
    async for chunk in request.stream():
        batch += chunk
        if len(batch) >= BATCH:
            await feed(bytes(batch))
            batch.clear()
    await feed(bytes(batch))


@router.get("", response_model=models.Assets)
def list_assets(deps: Deps, limit: Limit = models.PAGE, cursor: Cursor = None) -> Response:
    """List the assets, newest first, in pages. Lists of names and words are given with each single asset."""
    return page_response("assets", partial(deps.store.assets.page, deps.owner), shape, limit=limit, cursor=cursor)


@router.get("/{asset}", response_model=models.Asset)
def get_asset(asset: AssetId, deps: Deps) -> Response:
    """Get one asset. Long lists of names or words are at ``links.names`` alone."""
    return _reply(deps.store.assets.get(deps.owner, asset, limit=SHOWN_CHARACTERS), 200)


@router.get("/{asset}/names", response_model=models.Names)
def get_asset_names(asset: AssetId, deps: Deps, limit: Limit = models.PAGE, cursor: NamesCursor = 0) -> models.Names:
    """List the names of views, or the words, that an asset holds, in pages: pages of long names may have fewer."""
    names = deps.store.assets.names(deps.owner, asset, cursor, limit + 1)
    count = max(1, sum(total <= models.PAGE_CHARACTERS for total in accumulate(map(len, names[:limit]))))
    return models.Names(names=names[:count], next=cursor + count if len(names) > count else None)


@router.get("/{asset}/content", response_class=Response, responses=FILE)
def get_asset_content(asset: AssetId, request: Request, deps: Deps) -> Response:
    """Download an asset, or a range of its bytes."""
    record = deps.store.assets.get(deps.owner, asset)
    digest = record.id.removeprefix("sha256:")
    return file_answer(request, record.path, record.bytes, digest, record.file_name)


@router.patch("/{asset}", response_model=models.Asset, status_code=201, responses=KNOWN_ALREADY)
async def change_pack(asset: AssetId, change: models.PackChange, deps: Deps) -> Response:
    """Set the encoder or the text space of a feature pack: returns a new asset with the same features."""
    record, new = await anyio.to_thread.run_sync(_retagged, asset, change, deps, limiter=deps.checks)
    return _reply(record, 201 if new else 200)


def _retagged(asset: str, change: models.PackChange, deps: AppState) -> tuple[AssetRecord, bool]:
    source = deps.store.assets.get(deps.owner, asset, models.AssetKind.FEATURES)
    require_whole(source.path, source.bytes)
    limit = deps.settings.max_upload_bytes(models.AssetKind.FEATURES)
    intake = AssetIntake(deps.store, deps.owner, models.AssetKind.FEATURES, limit)
    try:
        intake.open()
        with deps.store.files.scratch() as scratch, source.path.open("rb") as pack:
            header = scratch / "header"
            arguments = [str(source.path), change.model_dump_json(exclude_none=True), str(header)]
            result = run_sandboxed("service.tasks.rename", arguments, scratch, deps.check_limits)
            if result is None:
                raise too_slow(models.AssetKind.FEATURES, deps.check_limits)
            if result.last["event"] == "invalid":
                raise error_of(result.last["fault"])
            if result.last["event"] != "valid":
                raise ProcessDied(
                    "asset", expected="a pack whose header is read", got="one that is not", hint="try again"
                )
            intake.feed(header.read_bytes())
            pack.seek(HEADER_LENGTH_BYTES + int.from_bytes(pack.read(HEADER_LENGTH_BYTES), "little"))
            while block := pack.read(BATCH):
                intake.feed(block)
        existing = intake.finish(None)
        return (existing, False) if existing is not None else intake.keep(intake.check(deps.check_limits))
    finally:
        intake.close()


@router.delete("/{asset}", status_code=204)
def delete_asset(asset: AssetId, deps: Deps) -> None:
    """Delete an asset. Refused (409) while a job or a lift refers to it."""
    deps.store.assets.delete(deps.owner, asset)


def shape(asset: AssetRecord) -> models.Asset:
    """Return an asset as clients get it."""
    path = f"/assets/{asset.id}"
    links = {"self": path, "content": f"{path}/content"}
    links |= {} if asset.kind is models.AssetKind.SPLATS else {"names": f"{path}/names"}
    return models.Asset.model_validate({**vars(asset), "links": links})


def _reply(asset: AssetRecord, status: int) -> Response:
    location = {"Location": f"/assets/{asset.id}"}
    return Response(shape(asset).model_dump_json(), status, media_type="application/json", headers=location)
