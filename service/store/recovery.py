"""Backups of a data directory, also of a running server, and rows for files whose database is lost.

A backup is laid out as a data directory, without work and drafts: the database and every file that it knows, whole or
absent. Files never change once they are stored, so they are linked where the file system can, and copied where it
cannot. A lost database is rebuilt from the files.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from liftcore.errors import InvalidInput, InvalidLift, NotFound, SplatliftError
from liftcore.files import identify
from service.errors import Misconfigured
from service.models import JOB_ID, AssetKind, LiftChange, UploadKind
from service.sandbox import SandboxLimits
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.database import DATABASE, KEYS_REQUIRED, copy_database, open_to_read, remember_generation
from service.store.files import keep_private, sha256_of, sync_directory
from service.store.lifts import FinishedLift, order_of
from service.store.owners import SERVICE
from service.store.store import Store
from service.uploads import LIFT, Report, check

TRIES = 10  # for a database with all of its files; each deletion meanwhile may cost one
CHUNK = 1 << 20


def back_up(data: Path, target: Path) -> int:
    """Copy a data directory, also while a server holds it; return the number of files beside the database.

    Raises:
        NotFound: there is no database.
        Misconfigured: the target is there already, or files that the database knows are lost.
    """
    _require_database(data)
    files, missing = set[str](), list[str]()
    with _made_whole(target) as folder:
        for _ in range(TRIES):  # the database first: files deleted after it are missing, and it is copied again
            copy_database(data / DATABASE, folder / DATABASE)
            files = {file for file, _, _ in _files(folder)}
            missing = [file for file in sorted(files) if not _linked(data / file, folder / file)]
            if not missing:
                break
        if missing:
            raise Misconfigured(
                "data", expected="all files that the database knows",
                got=f"{len(missing)} lost, such as {missing[0]}",
                hint="splatlift store verify tells which; delete what they belong to, then back up again",
            )  # fmt: skip
        for path in [path for name in ("blobs", "lifts") for path in (folder / name).rglob("*") if path.is_file()]:
            if str(path.relative_to(folder)) not in files:  # deleted meanwhile
                path.unlink()
        for path in data.glob("lifts/*.json"):
            if str(path.relative_to(data).with_suffix(".safetensors")) in files:
                _linked(path, folder / path.relative_to(data))
        if (data / KEYS_REQUIRED).exists():
            shutil.copy(data / KEYS_REQUIRED, folder / KEYS_REQUIRED)
        remember_generation(folder, _generation(folder))
    return len(files)


def restore(backup: Path, data: Path) -> int:
    """Restore a data directory from a backup; return the number of files beside the database.

    Raises:
        NotFound: it is no backup.
        Misconfigured: the data directory is there already, or the backup is damaged.
    """
    _require_database(backup)
    if damage := verify(backup):
        raise Misconfigured(
            "backup", expected="files as they were stored", got=f"{len(damage)} that are not, such as {damage[0]}"
        )
    return back_up(backup, data)


def verify(data: Path) -> list[str]:
    """Return the damage of a data directory or a backup, a line each: files that are lost or changed.

    Raises:
        NotFound: there is no database.
    """
    _require_database(data)
    with closing(open_to_read(data / DATABASE)) as connection:
        damage = [
            f"{DATABASE}: {row[0]}" for row in connection.execute("PRAGMA integrity_check(10)") if row[0] != "ok"
        ]
        charts = connection.execute("SELECT id, sha256, chart FROM tradeoffs")
        damaged = [job for job, digest, chart in charts if hashlib.sha256(chart).hexdigest() != digest]
    damage += [f"trade-off {job}: another chart" for job in damaged]
    for file, size, digest in _files(data):
        reason = _damage_of(data / file, size, digest)
        if reason is not None and (file, size, digest) in _files(data):  # else it was deleted meanwhile
            damage.append(f"{file}: {reason}")
    return damage


def _damage_of(path: Path, size: int, digest: str) -> str | None:
    if path.exists() and not path.is_file():
        return "no regular file"
    try:
        with path.open("rb") as handle:
            actual = hashlib.file_digest(handle, "sha256").hexdigest()
            count = handle.tell()
    except OSError as error:
        return error.strerror
    if count != size:
        return f"{count} bytes in place of {size}"
    return None if actual == digest else f"other bytes: their sha256 is {actual}, not {digest}"


def _files(data: Path) -> list[tuple[str, int, str]]:
    """Return path below the directory, bytes and sha256 of every file in the database."""
    with closing(open_to_read(data / DATABASE)) as connection:
        return connection.execute(
            "SELECT file, bytes, substr(id, 8) FROM assets UNION SELECT file, bytes, sha256 FROM lifts"
        ).fetchall()


def _generation(data: Path) -> int:
    with closing(open_to_read(data / DATABASE)) as connection:
        return connection.execute("SELECT number FROM generation").fetchone()[0]


def _linked(source: Path, target: Path) -> bool:
    """Return True if a regular file of one directory is also in the other."""
    if not source.is_file():
        return False
    if target.exists():
        return source.exists()
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        return False
    except OSError:  # another file system, or one without hard links
        try:
            with source.open("rb") as original, target.open("wb") as copy:
                shutil.copyfileobj(original, copy, CHUNK)
                copy.flush()
                os.fsync(copy.fileno())
        except FileNotFoundError:
            return False
    return True


@contextmanager
def _made_whole(target: Path) -> Iterator[Path]:
    """Yield a folder beside the target, which replaces the target at the end and is removed after an error."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise Misconfigured(
            "directory", expected="one that is not there yet, or empty", got=str(target), hint="move it away first"
        )
    folder = target.absolute().with_name(f".{target.name}.part")
    shutil.rmtree(folder, ignore_errors=True)
    keep_private(folder)
    try:
        yield folder
        for subfolder in [path for path in folder.rglob("*") if path.is_dir()]:
            sync_directory(subfolder)
        sync_directory(folder)
        folder.replace(target)
        sync_directory(target.absolute().parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _require_database(data: Path) -> None:
    if not (data / DATABASE).is_file():
        raise NotFound("data", expected=f"a directory with a {DATABASE}", got=str(data), hint="name it with --data")


# Rows for files whose database is lost or older than they are


def rebuild(store: Store, settings: ServiceSettings) -> dict[str, Any]:
    """Add rows for files without one, and declare the database the newest of its directory.

    Returns:
        ``assets`` by kind and ``lifts``: how many were added; ``left``: files that could not be, and why.
    """
    root, failures, counts = store.files.root, list[dict[str, str]](), Counter[UploadKind]()
    recorded = {record.path for record in (*store.assets.all(SERVICE), *store.lifts.all(SERVICE))}
    changes = {path for path in root.glob("lifts/*.json") if store.files.lift(path.stem).exists()}
    for add, pattern in ((_add_asset, "blobs/*/*"), (_add_lift, "lifts/*")):  # lifts refer to assets
        for path in sorted(set(root.glob(pattern)) - recorded - changes):
            try:
                counts[add(store, settings, path)] += 1
            except SplatliftError as error:
                failures.append({"file": store.files.relative(path), "why": str(error)})
    for path in sorted(changes):
        try:
            _change_lift(store, path)
        except SplatliftError as error:
            failures.append({"file": store.files.relative(path), "why": str(error)})
    store.database.catch_up()
    lifts = counts.pop(LIFT, 0)
    return {"assets": dict(counts), "lifts": lifts, "left": failures}


def _add_asset(store: Store, settings: ServiceSettings, path: Path) -> AssetKind:
    """Check a blob: its name must be its digest, and its content is checked like an upload."""
    if not path.is_file():
        raise NotFound("asset", expected="a regular file", got="something else")
    digest = sha256_of(path)
    if path != store.files.blob(digest, path.suffix):
        raise NotFound("asset", expected="a file named after its sha256", got=f"one whose sha256 is {digest}")
    kind = _kind_of(path)
    report = check_file(store, settings, kind, path)
    # The file is its own draft: it stays in place.
    store.assets.add(SERVICE, CheckedUpload(path, kind, digest, path.suffix, report.counts, report.warnings))
    return kind


def check_file(store: Store, settings: ServiceSettings, kind: UploadKind, *paths: Path) -> Report:
    """Return the result of the upload check of a file, with the files that it needs."""
    limits = SandboxLimits(settings.check_seconds, settings.check_memory_bytes, threading.Event())
    with store.files.scratch() as scratch:
        return check(kind, paths[0], scratch, limits, *paths[1:])


def _kind_of(path: Path) -> AssetKind:
    kind = identify(path)
    if kind.kind not in set(AssetKind):
        raise NotFound("asset", expected="a file of an asset", got=kind.name)
    return AssetKind(kind.kind)


def _add_lift(store: Store, settings: ServiceSettings, path: Path) -> UploadKind:
    """Return the order of a lift's job from its file, which records the settings and the digests of its inputs.

    One that was brought may have been made with a folder of cameras: then those of its poses are looked for.
    """
    if not re.match(JOB_ID, path.stem) or path != store.files.lift(path.stem) or not path.is_file():
        raise InvalidLift("lift", expected="a file named after its job", got=path.name)
    _, metadata, shape = header_of(path)
    try:
        document = json.loads(metadata["splatlift"])
        order = order_of(document)
        count, channels = shape
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidLift("lift", expected="the metadata of a lift", got=f"none that tell of it: {error!r}") from None
    if document.get("poses") and store.assets.find(SERVICE, order.cameras) is None:
        order = replace(order, cameras=_cameras_of(store, settings, path) or order.cameras)
    packs = tuple(pack for pack in order.features if store.assets.find(SERVICE, pack) is not None)
    order = replace(order, features=packs)  # an uploaded lift may have no packs here
    for asset, kind in order.assets():
        store.assets.get(SERVICE, asset, kind)  # a lift without its splats and cameras cannot be shown
    store.lifts.adopt(SERVICE, path.stem, order, FinishedLift(path, sha256_of(path), count, channels, document))
    return LIFT


def _change_lift(store: Store, path: Path) -> None:
    """Restore the changes of a lift, except photos that are lost."""
    try:
        changes = LiftChange.model_validate_json(path.read_bytes()).model_dump(exclude_unset=True)
    except (OSError, ValueError) as error:
        store.files.quarantine([path])
        got = " ".join(str(error).split())[:120]
        raise InvalidLift("lift", expected="the changes of a lift as JSON", got=got) from None
    if changes.get("photos") is not None and store.assets.find(SERVICE, changes["photos"]) is None:
        del changes["photos"]
    store.lifts.change(SERVICE, path.stem, changes)


def _cameras_of(store: Store, settings: ServiceSettings, lift: Path) -> str | None:
    for asset in store.assets.all(SERVICE):
        if asset.kind is AssetKind.CAMERAS:
            with suppress(InvalidInput):
                check_file(store, settings, LIFT, lift, asset.path)
                return asset.id
    return None


def header_of(path: Path) -> tuple[set[str], dict[str, str], list[int]]:
    """Return the names of tensors, the metadata and the shape of ``features`` of a safetensors file."""
    try:
        handle: Any
        with safe_open(str(path), framework="np") as handle:
            names = set(handle.keys())
            shape = handle.get_slice("features").get_shape() if "features" in names else []
            return names, handle.metadata() or {}, shape
    except (SafetensorError, OSError) as error:
        raise InvalidLift("file", expected="a whole safetensors file", got=str(error)[:120]) from None
