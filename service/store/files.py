"""The files of the service: private drafts, and complete blobs and lifts."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import secrets
import shutil
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from liftcore.errors import NotFound
from service.errors import Misconfigured, NoSpace

LOCK_SECONDS = 0.5  # that another process may take to release the directory
FOLDERS = ("blobs", "lifts", "work")
QUARANTINE_TIME = "%Y%m%dT%H%M%SZ"  # the name of a folder in the quarantine: its time


class DataDirectory:
    """One data directory, held by one server at a time.

    ``blobs/ab/abcd....ply`` are assets by digest, ``lifts/ID.safetensors`` lifts by job, ``lifts/ID.json`` what was
    changed of one since, ``work/ID/`` what a job that was interrupted goes on from, ``tmp/`` drafts,
    ``quarantine/TIME-RANDOM/`` what nothing reached at that time, under the path that it had.

    Args:
        root: the directory; made when it is not there.
        floor_bytes: free disk that new work must leave.
    """

    def __init__(self, root: Path, *, floor_bytes: int = 0) -> None:
        self.root = root.resolve()  # resolved once, as it stands in errors
        self._floor = floor_bytes
        # Held while a blob is added or removed, so that no deletion removes the bytes of a new upload.
        self.blobs_changing = threading.Lock()
        self._live: set[str] = set()  # names below tmp/ in use; adding and removing one is atomic
        keep_private(self.root)
        self.make_folders()
        self._lock = (self.root / "lock").open("w")
        if not _locked(self._lock):
            self._lock.close()
            raise Misconfigured(
                "data", expected="a directory that no other server uses", got=str(root),
                hint="stop the other server or name another directory with --data",
            )  # fmt: skip
        # Files below tmp/ were never acknowledged, and the server that wrote them has ended.
        shutil.rmtree(self.root / "tmp")
        (self.root / "tmp").mkdir()

    def make_folders(self) -> None:
        """Create the folders that are missing: someone may tidy up while the server runs."""
        for name in (*FOLDERS, "tmp"):
            (self.root / name).mkdir(exist_ok=True)

    @contextmanager
    def draft(self, suffix: str) -> Iterator[Path]:
        """Yield a path to write to; a file that is still there after the block is removed."""
        self.make_folders()
        path = self.root / "tmp" / f"{secrets.token_hex(16)}{suffix}"
        self._live.add(path.name)
        try:
            yield path
        finally:
            self._live.discard(path.name)
            for remnant in path.parent.glob(f"*{path.name}*"):  # and the drafts that writers keep beside it
                remnant.unlink(missing_ok=True)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield a folder for a child process; it is removed with its content, however the child ends."""
        self.make_folders()
        folder = self.root / "tmp" / secrets.token_hex(16)
        self._live.add(folder.name)
        folder.mkdir(mode=0o700)
        try:
            yield folder
        finally:
            self._live.discard(folder.name)
            shutil.rmtree(folder, ignore_errors=True)

    def left_over(self) -> list[Path]:
        """Return the paths below tmp/ that belong to no open draft or scratch folder."""
        live = set(self._live)
        return [path for path in (self.root / "tmp").iterdir() if not any(name in path.name for name in live)]

    @property
    def floor_bytes(self) -> int:
        """Return the free disk space that new work must leave."""
        return self._floor

    def free_bytes(self) -> int:
        """Return the free disk space that may be used."""
        return shutil.disk_usage(self.root).free

    def require_room(self, coming: int = 0) -> None:
        """Require space for new work.

        Args:
            coming: bytes that are known to come.

        Raises:
            NoSpace: less than the floor would be left.
        """
        free = self.free_bytes()
        if free - coming < self._floor:
            raise NoSpace(
                "data", expected=f"{self._floor + coming} bytes of free disk", got=f"{free}",
                hint="delete assets, or jobs with their lifts, or ask the operator for room",
            )  # fmt: skip

    def work(self, job: str) -> Path:
        """Return the folder for a job's checkpoint; its child creates it."""
        return self.root / "work" / job

    def forget_work(self, job: str) -> None:
        """Remove that folder."""
        remove(self.work(job))

    def blob(self, digest: str, suffix: str) -> Path:
        """Return the path of the asset with that digest."""
        return self.root / "blobs" / digest[:2] / f"{digest}{suffix}"

    def lift(self, job: str) -> Path:
        """Return the path of a job's lift."""
        return self.root / "lifts" / f"{job}.safetensors"

    def lift_changes(self, job: str) -> Path:
        """Return the path of a lift's changes, if there are any."""
        return self.lift(job).with_suffix(".json")

    def relative(self, path: Path) -> str:
        """Return the path as the database stores it."""
        return str(path.relative_to(self.root))

    def quarantine(self, paths: Iterable[Path]) -> list[Path]:
        """Move files and folders to quarantine, to be removed after a time or moved back.

        Returns:
            The former paths of moved files.
        """
        # A folder for each call, so that nothing is replaced.
        now = datetime.now(UTC).strftime(QUARANTINE_TIME)
        folder = self.root / "quarantine" / f"{now}-{secrets.token_hex(4)}"
        sources = []
        for path in paths:
            target = folder / path.relative_to(self.root)
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.rename(target)
            except FileNotFoundError:  # its owner removed it
                continue
            sources.append(path)
        return sources

    def quarantined(self) -> list[tuple[Path, float]]:
        """Return the folders of the quarantine with their times; folders with other names are ignored."""
        folders = []
        for folder in (self.root / "quarantine").glob("*-*"):
            try:
                since = datetime.strptime(folder.name.partition("-")[0], QUARANTINE_TIME).replace(tzinfo=UTC)
            except ValueError:
                continue
            folders.append((folder, since.timestamp()))
        return folders

    def begin_anew(self, database: str, marker: str) -> None:
        """Move all files to quarantine, with the database and its markers."""
        names = (*FOLDERS, *(f"{database}{part}" for part in ("", "-wal", "-shm")))
        # The marker last: while it is here, an interrupted call cannot leave half a directory in use.
        self.quarantine(path for name in (*names, marker) if (path := self.root / name).exists())
        self.make_folders()

    def publish(self, draft: Path, path: Path) -> None:
        """Move a draft to ``path``: first to the disk, then atomically.

        A file that is its own draft is there.
        """
        if draft == path:
            return
        path.parent.mkdir(exist_ok=True)
        with draft.open("rb") as handle:
            os.fsync(handle.fileno())
        draft.replace(path)
        for directory in (path.parent, path.parent.parent):
            sync_directory(directory)

    def close(self) -> None:
        """Release the directory to other servers."""
        self._lock.close()


def keep_private(root: Path) -> None:
    """Create a data directory if needed, and protect it and all future files from other users."""
    os.umask(0o077)  # of this process and its children, which work in nothing else
    root.mkdir(parents=True, exist_ok=True)
    root.chmod(0o700)
    for path in root.glob("*.sqlite*"):  # of a release that left them readable
        path.chmod(0o600)


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content; garbage collection removes what cannot be removed now."""
    try:
        path.unlink()
    except OSError:
        shutil.rmtree(path, ignore_errors=True)


def sha256_of(path: Path) -> str:
    """Return the sha256 of a file's bytes, in hex."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def is_whole(path: Path, size: int) -> bool:
    """Return True if a regular file still has its stored size; a pipe in its place would block."""
    try:
        require_whole(path, size)
    except NotFound:
        return False
    return True


def require_whole(path: Path, size: int) -> os.stat_result:
    """Return the system's error for such a file.

    Raises:
        NotFound: it is not there, or no longer what was stored.
    """
    with contextlib.suppress(OSError):
        status = path.stat()
        if stat.S_ISREG(status.st_mode) and status.st_size == size:
            return status
    raise NotFound(
        "content", expected=f"a file of {size} bytes in the data directory",
        got="one of another size" if path.exists() else "none",
        hint="it was deleted a moment ago, or something else wrote there: upload it again, or lift again",
    )  # fmt: skip


def _locked(lock: TextIO) -> bool:
    """Take the lock; a process that only checks for a server holds it for a moment too."""
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            if time.monotonic() > deadline:
                return False
            time.sleep(LOCK_SECONDS / 10)
        else:
            return True


def sync_directory(path: Path) -> None:
    """Flush a directory, so that a renamed file is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
