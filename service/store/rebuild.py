"""Rows for files whose database is gone or older than they are, made of what the files tell of themselves."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from liftcore.errors import InvalidInput, InvalidLift, NotFound, SplatliftError
from liftcore.io.kinds import identify
from service.errand import ErrandLimits
from service.models import JOB_ID, AssetKind, UploadKind
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.lifts import FinishedLift, order_of
from service.store.owners import SERVICE
from service.store.store import Store
from service.uploads import LIFT, Report, check


def rebuild(store: Store, settings: ServiceSettings) -> dict[str, Any]:
    """Give rows to the files that have none, and let the database be the newest one of its directory.

    Returns:
        ``assets`` by kind and ``lifts``: how many were added; ``left``: files that could not be, and why.
    """
    left: list[dict[str, str]] = []
    assets: Counter[str] = Counter()
    known = {asset.path for asset in store.assets.all(SERVICE)}
    for path in sorted(store.files.root.glob("blobs/*/*")):
        if path not in known:
            try:
                assets[_add_asset(store, settings, path)] += 1
            except SplatliftError as error:
                left.append({"file": store.files.relative(path), "why": str(error)})
    lifts = 0
    known = {lift.path for lift in store.lifts.all(SERVICE)}
    for path in sorted(store.files.root.glob("lifts/*")):
        if path not in known:
            try:
                _add_lift(store, settings, path)
                lifts += 1
            except SplatliftError as error:
                left.append({"file": store.files.relative(path), "why": str(error)})
    store.database.catch_up()
    return {"assets": dict(assets), "lifts": lifts, "left": left}


def _add_asset(store: Store, settings: ServiceSettings, path: Path) -> AssetKind:
    """A blob is whole when its name is its digest; what it holds is read by the check of uploads."""
    if not path.is_file():
        raise NotFound("asset", expected="a regular file", got="something else")
    with path.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    if path != store.files.blob(digest, path.suffix):
        raise NotFound("asset", expected="a file named after its sha256", got=f"one whose sha256 is {digest}")
    kind = _kind_of(path)
    report = _checked(store, settings, kind, path)
    # The file is its own draft: it stays where it is.
    store.assets.add(SERVICE, CheckedUpload(path, kind, digest, path.suffix, report.counts, report.warnings))
    return kind


def _checked(store: Store, settings: ServiceSettings, kind: UploadKind, *paths: Path) -> Report:
    limits = ErrandLimits(settings.check_seconds, settings.check_memory_bytes, threading.Event())
    with store.files.scratch() as scratch:
        return check(kind, paths[0], scratch, limits, *paths[1:])


def _kind_of(path: Path) -> AssetKind:
    found = identify(path)
    if found.kind not in set(AssetKind):
        raise NotFound("asset", expected="a file of an asset", got=found.name)
    return AssetKind(found.kind)


def _add_lift(store: Store, settings: ServiceSettings, path: Path) -> None:
    """A lift remembers the settings and the digests of what it was made of: that is its job's order.

    One that was brought may have been made with a folder of cameras: then those of its poses are looked for.
    """
    if not re.match(JOB_ID, path.stem) or path != store.files.lift(path.stem) or not path.is_file():
        raise InvalidLift("lift", expected="a file named after its job", got=path.name)
    _, metadata, shape = header_of(path)
    try:
        told = json.loads(metadata["splatlift"])
        order = order_of(told)
        count, channels = shape
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidLift("lift", expected="the metadata of a lift", got=f"none that tell of it: {error!r}") from None
    if told.get("poses") and store.assets.find(SERVICE, order.cameras) is None:
        order = replace(order, cameras=_cameras_of(store, settings, path) or order.cameras)
    here = tuple(pack for pack in order.features if store.assets.find(SERVICE, pack) is not None)
    order = replace(order, features=here)  # lifts may be brought without their packs
    for asset, kind in order.assets():
        store.assets.get(SERVICE, asset, kind)  # a lift without what it was made of can be shown to nobody
    with path.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    store.lifts.adopt(SERVICE, path.stem, order, FinishedLift(path, digest, count, channels, told))


def _cameras_of(store: Store, settings: ServiceSettings, lift: Path) -> str | None:
    for asset in store.assets.all(SERVICE):
        if asset.kind is AssetKind.CAMERAS:
            with suppress(InvalidInput):
                _checked(store, settings, LIFT, lift, asset.path)
                return asset.id
    return None


def header_of(path: Path) -> tuple[set[str], dict[str, str], list[int]]:
    """Names of tensors, metadata and the shape of ``features``, of a safetensors file."""
    try:
        handle: Any
        with safe_open(str(path), framework="np") as handle:
            names = set(handle.keys())
            shape = handle.get_slice("features").get_shape() if "features" in names else []
            return names, handle.metadata() or {}, shape
    except (SafetensorError, OSError) as error:
        raise InvalidLift("file", expected="a whole safetensors file", got=str(error)[:120]) from None
