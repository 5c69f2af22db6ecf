"""Results of jobs: changes and downloads of lifts, lift files that are brought, trade-offs, and shares of lifts."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidLift, NotFound
from liftcore.files import require_pairs
from service.errors import Conflict, InvalidRequest
from service.models import Key, Lift, NewShare, Share, Tradeoff
from service.store import LIFTS, VALID, VISIBLE, Owner, Store, create_key, sync

MOST_SHARES = 100  # valid keys of one lift


def change_lift(store: Store, owner: Owner, lift: str, changes: dict[str, Any]) -> Lift:
    """Set a lift's ``name``, ``photos`` (an asset) or ``world``; None removes them."""
    with store.write() as connection:
        store.lift(owner, lift)
        if photos := changes.get("photos"):
            store.asset(owner, photos, "photos")
            rows = store.rows("SELECT owner FROM jobs WHERE id = :id", id=lift)
            store.own_asset(rows[0]["owner"], photos)
        if "world" in changes:
            changes = changes | {"world": json.dumps(changes["world"] or {})}
        for column in changes.keys() & {"name", "photos", "world"}:
            connection.execute(f"UPDATE lifts SET {column} = ? WHERE id = ?", (changes[column] or None, lift))
    return store.lift(owner, lift)


def find_lift_file(store: Store, owner: Owner, sha256: str) -> Lift | None:
    """Return the lift of a file with that digest; None if there is none."""
    rows = store.rows(f"{LIFTS} WHERE {VISIBLE} AND sha256 = :sha256 LIMIT 1", sha256=sha256, **vars(owner))
    return Lift.of_row(rows[0]) if rows else None


def add_lift(store: Store, owner: Owner, draft: Path, content: dict[str, Any], cameras: str | None = None) -> Lift:
    """Store a checked lift file, as the result of a job that never ran, with its own or other cameras."""
    metadata = content["metadata"]
    files = (metadata["splats"], metadata["cameras"], *metadata["features"])
    splats_id, own_cameras, *packs = [f"sha256:{file['sha256']}" for file in files]
    fields = {
        "kind": "lift", "splats": splats_id, "cameras": cameras or own_cameras, "settings": metadata["settings"],
        "features": [pack for pack in packs if store.find_asset(owner, pack)], "parameters": {},
    }  # fmt: skip
    splats = store.asset(owner, splats_id, "splats")
    if splats.counts["splats"] != content["count"]:
        got = f"{content['count']} for {splats.counts['splats']} splats"
        raise InvalidLift("lift", expected="a row for each splat", got=got)
    try:
        seen_views = store.asset(owner, fields["cameras"], "cameras").counts.get("names")
    except NotFound as error:
        hint = "PUT its file of cameras first; in place of a folder a zip of it, named here as ?cameras=ID"
        raise NotFound(error.argument, expected=error.expected, got=error.got, hint=hint) from None
    if seen_views is not None and metadata["views"]:
        require_pairs(metadata["views"], seen_views)
    sync(draft)
    now = time.time()
    with store.write():
        for asset in (fields["splats"], fields["cameras"], *fields["features"]):
            store.asset(owner, asset)
            store.own_asset(owner.owner, asset)
        job = store.insert_job(owner.owner, fields, state="succeeded", attempt=1, started=now)
        store.insert_lift(job, content, draft, store.root / "lifts" / f"{job}.safetensors")
    return store.lift(owner, job)


def get_tradeoff(store: Store, owner: Owner, tradeoff: str) -> tuple[Tradeoff, bytes]:
    """Return the trade-off of that id, and its chart as a PNG."""
    rows = store.rows("SELECT * FROM tradeoffs WHERE id = :id", id=tradeoff)
    if not rows:
        hint = "POST /tradeoff makes one; it has its job's id"
        raise NotFound("tradeoff", expected="the id of a trade-off", got=tradeoff[:80], hint=hint)
    job, result = store.job(owner, tradeoff), rows[0]["document"]
    inputs = {"splats": job.splats, "cameras": job.cameras, "features": job.features}
    fields = {"id": job.id, **inputs, "labels": job.parameters.get("labels"), "created": job.ended}
    return Tradeoff.model_validate({**result["document"], "table": result["page"], **fields}), rows[0]["chart"]


# Keys shared for one lift


def list_shares(store: Store, lift: str) -> list[Share]:
    """Return the valid shares of a lift, newest first. The caller must see the lift."""
    holders = f"SELECT * FROM keys WHERE :lift IN (SELECT value FROM json_each(lifts)) AND {VALID}"
    rows = store.rows(f"{holders} ORDER BY created DESC, id", lift=lift, now=time.time())
    return [Share(**row, lift=lift) for row in rows]


def create_share(store: Store, maker: Key | None, lift: str, name: str, seconds: float) -> NewShare:
    """Create a key that can read and query a lift. It ends with the key that makes it, at the latest."""
    if maker is None:
        hint, got = "the operator makes a first key with splatlift keys create", "one that is open to its machine"
        raise InvalidRequest("Authorization", expected="a service that wants keys", got=got, hint=hint)
    expires = min(time.time() + seconds, maker.expires or float("inf"))
    with store.write() as connection:
        if len(list_shares(store, lift)) >= MOST_SHARES:
            expected, hint = f"at most {MOST_SHARES} of a lift", "delete some first"
            raise Conflict("share", expected=expected, got="more", hint=hint)
        key, secret = create_key(connection, name, "shared", expires, [lift], maker.id)
    return NewShare(**key.model_dump(), lift=lift, key=secret)


def delete_share(store: Store, lift: str, share: str) -> None:
    """Take a lift away from a key; a key without lifts is revoked."""
    with store.write() as connection:
        rows = store.rows("SELECT lifts FROM keys WHERE id = :id", id=share)
        lifts = rows[0]["lifts"] if rows else []
        if lift not in lifts:
            hint = "GET /lifts/{lift}/shares lists them"
            raise NotFound("share", expected="the id of a share of the lift", got=share[:80], hint=hint)
        rest = [other for other in lifts if other != lift]
        revoked = None if rest else time.time()
        update = "UPDATE keys SET lifts = ?, revoked = coalesce(revoked, ?) WHERE id = ?"
        connection.execute(update, (json.dumps(rest), revoked, share))
