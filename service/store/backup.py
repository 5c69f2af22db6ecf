"""Backups of a data directory, beside a server that runs: the database and every file that it knows, whole or absent.

A backup is laid out as a data directory, without work and drafts. Files never change once they are stored, so they
are linked where the file system can, and copied where it cannot.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from liftcore.errors import NotFound
from service.errors import Misconfigured
from service.store.database import DATABASE, KEYS_REQUIRED, copy_database, open_to_read, remember_generation
from service.store.files import keep_private, sync_directory

TRIES = 10  # of a database whose files all are here; each DELETE meanwhile may cost one
CHUNK = 1 << 20


def back_up(data: Path, target: Path) -> int:
    """Copy a data directory, whether a server holds it or not; how many files there are beside the database.

    Raises:
        NotFound: there is no database.
        Misconfigured: the target is there already, or files that the database knows are lost.
    """
    _require_database(data)
    known, lost = set[str](), list[str]()
    with _made_whole(target) as folder:
        for _ in range(TRIES):  # the database first: what is deleted after it is missed, and looked for anew
            copy_database(data / DATABASE, folder / DATABASE)
            known = {file for file, _, _ in _files(folder)}
            lost = [file for file in sorted(known) if not _linked(data / file, folder / file)]
            if not lost:
                break
        if lost:
            raise Misconfigured(
                "data", expected="all files that the database knows", got=f"{len(lost)} lost, such as {lost[0]}",
                hint="splatlift store verify tells which; delete what they belong to, then back up again",
            )  # fmt: skip
        for path in [path for room in ("blobs", "lifts") for path in (folder / room).rglob("*") if path.is_file()]:
            if str(path.relative_to(folder)) not in known:  # deleted while we tried
                path.unlink()
        if (data / KEYS_REQUIRED).exists():
            shutil.copy(data / KEYS_REQUIRED, folder / KEYS_REQUIRED)
        remember_generation(folder, _generation(folder))
    return len(known)


def restore(backup: Path, data: Path) -> int:
    """Make a data directory of a backup; how many files there are beside the database.

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
    """What is wrong with a data directory or a backup, a line each: files that are lost or not as they were stored.

    Raises:
        NotFound: there is no database.
    """
    _require_database(data)
    with closing(_opened(data)) as connection:
        damage = [
            f"{DATABASE}: {row[0]}" for row in connection.execute("PRAGMA integrity_check(10)") if row[0] != "ok"
        ]
        charts = connection.execute("SELECT id, chart, sha256 FROM tradeoffs")
        damage += [f"trade-off {job}: another chart" for job, *found in charts if _digest_of(found[0]) != found[1]]
    for file, size, digest in _files(data):
        why = _damage_of(data / file, size, digest)
        if why is not None and (file, size, digest) in _files(data):  # else it was deleted while we looked
            damage.append(f"{file}: {why}")
    return damage


def _damage_of(path: Path, size: int, digest: str) -> str | None:
    if path.exists() and not path.is_file():
        return "no regular file"
    try:
        with path.open("rb") as handle:
            found = hashlib.file_digest(handle, "sha256").hexdigest()
            read = handle.tell()
    except OSError as error:
        return error.strerror
    if read != size:
        return f"{read} bytes in place of {size}"
    return None if found == digest else f"other bytes: their sha256 is {found}, not {digest}"


def _files(data: Path) -> list[tuple[str, int, str]]:
    """Path below the directory, bytes and sha256 of every file that the database knows."""
    with closing(_opened(data)) as connection:
        return connection.execute(
            "SELECT file, bytes, substr(id, 8) FROM assets UNION SELECT file, bytes, sha256 FROM lifts"
        ).fetchall()


def _generation(data: Path) -> int:
    with closing(_opened(data)) as connection:
        return connection.execute("SELECT number FROM generation").fetchone()[0]


def _opened(data: Path) -> sqlite3.Connection:
    return open_to_read(data / DATABASE)


def _digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _linked(source: Path, target: Path) -> bool:
    """Whether a regular file, that is there, is there too."""
    if not source.is_file():
        return False
    if target.exists():
        return source.exists()
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        return False
    except OSError:  # another file system, or one without links
        try:
            with source.open("rb") as read, target.open("wb") as written:
                shutil.copyfileobj(read, written, CHUNK)
                written.flush()
                os.fsync(written.fileno())
        except FileNotFoundError:
            return False
    return True


@contextmanager
def _made_whole(target: Path) -> Iterator[Path]:
    """A folder beside the target, which becomes the target at the end and is removed after an error."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise Misconfigured(
            "directory", expected="one that is not there yet, or empty", got=str(target), hint="move it away first"
        )
    folder = target.absolute().with_name(f".{target.name}.part")
    shutil.rmtree(folder, ignore_errors=True)
    keep_private(folder)
    try:
        yield folder
        for found in [path for path in folder.rglob("*") if path.is_dir()]:
            sync_directory(found)
        sync_directory(folder)
        folder.replace(target)
        sync_directory(target.absolute().parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _require_database(data: Path) -> None:
    if not (data / DATABASE).is_file():
        raise NotFound("data", expected=f"a directory with a {DATABASE}", got=str(data), hint="name it with --data")
