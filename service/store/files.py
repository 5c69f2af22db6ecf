"""The files of the service: drafts that nobody sees, and blobs and lifts that are whole."""

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

LOCK_SECONDS = 0.5  # for another process to let go of the directory
FOLDERS = ("blobs", "lifts", "work")
QUARANTINE_TIME = "%Y%m%dT%H%M%SZ"  # how a folder of the quarantine tells since when it is there


class DataDirectory:
    """One directory, held by one server at a time.

    ``blobs/ab/abcd....ply`` are assets by digest, ``lifts/ID.safetensors`` lifts by job, ``lifts/ID.json`` what was
    changed of one since, ``work/ID/`` what a job that was interrupted goes on from, ``tmp/`` drafts,
    ``quarantine/TIME-RANDOM/`` what nothing reached at that time, under the path that it had.

    Args:
        root: the directory; made when it is not there.
        floor_bytes: free disk that new work must leave.
    """

    def __init__(self, root: Path, *, floor_bytes: int = 0) -> None:
        self.root = root.resolve()  # a path in an error is the one that was opened
        self._floor = floor_bytes
        # Held while a blob appears or goes, so that no delete removes the bytes of a new upload.
        self.blobs_changing = threading.Lock()
        self._live: set[str] = set()  # names below tmp/ that are in use; adding and removing one is atomic
        keep_private(self.root)
        self.make_folders()
        self._lock = (self.root / "lock").open("w")
        if not _locked(self._lock):
            self._lock.close()
            raise Misconfigured(
                "data", expected="a directory that no other server uses", got=str(root),
                hint="stop the other server or name another directory with --data",
            )  # fmt: skip
        # Nothing below tmp/ was ever acknowledged, and the server that wrote it is gone.
        shutil.rmtree(self.root / "tmp")
        (self.root / "tmp").mkdir()

    def make_folders(self) -> None:
        """Make the folders of files and drafts that are missing: somebody may tidy up while the server runs."""
        for name in (*FOLDERS, "tmp"):
            (self.root / name).mkdir(exist_ok=True)

    @contextmanager
    def draft(self, suffix: str) -> Iterator[Path]:
        """A path to write to; what is still there when the block ends is removed."""
        self.make_folders()
        path = self.root / "tmp" / f"{secrets.token_hex(16)}{suffix}"
        self._live.add(path.name)
        try:
            yield path
        finally:
            self._live.discard(path.name)
            for remnant in path.parent.glob(f"*{path.name}*"):  # with the drafts that writers keep beside it
                remnant.unlink(missing_ok=True)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder for what a child process unpacks; nothing of it is left, however the child ends."""
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
        """What lies below tmp/ and belongs to no draft and no scratch folder that is still open."""
        live = set(self._live)
        return [path for path in (self.root / "tmp").iterdir() if not any(name in path.name for name in live)]

    @property
    def floor_bytes(self) -> int:
        """Free disk that new work must leave."""
        return self._floor

    def free_bytes(self) -> int:
        """Free disk that is ours to use."""
        return shutil.disk_usage(self.root).free

    def require_room(self, coming: int = 0) -> None:
        """See that there is room for new work.

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
        """The folder of what a job has done so far; its child makes it."""
        return self.root / "work" / job

    def forget_work(self, job: str) -> None:
        """Remove that folder."""
        remove(self.work(job))

    def blob(self, digest: str, suffix: str) -> Path:
        """Where an asset of that digest lies."""
        return self.root / "blobs" / digest[:2] / f"{digest}{suffix}"

    def lift(self, job: str) -> Path:
        """Where the lift of a job lies."""
        return self.root / "lifts" / f"{job}.safetensors"

    def lift_changes(self, job: str) -> Path:
        """The path of a lift's changes, if there are any."""
        return self.lift(job).with_suffix(".json")

    def relative(self, path: Path) -> str:
        """The path as the database keeps it."""
        return str(path.relative_to(self.root))

    def quarantine(self, paths: Iterable[Path]) -> list[Path]:
        """Move files and folders away from where they are seen, to be removed after a time or moved back.

        Returns:
            What was moved, where it was.
        """
        # A folder for each time that something is moved, so that nothing replaces what is there.
        now = datetime.now(UTC).strftime(QUARANTINE_TIME)
        folder = self.root / "quarantine" / f"{now}-{secrets.token_hex(4)}"
        sources = []
        for path in paths:
            target = folder / path.relative_to(self.root)
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.rename(target)
            except FileNotFoundError:  # its owner was quicker
                continue
            sources.append(path)
        return sources

    def quarantined(self) -> list[tuple[Path, float]]:
        """The folders of the quarantine, and since when each is there; those with other names are nobody's."""
        folders = []
        for folder in (self.root / "quarantine").glob("*-*"):
            try:
                since = datetime.strptime(folder.name.partition("-")[0], QUARANTINE_TIME).replace(tzinfo=UTC)
            except ValueError:
                continue
            folders.append((folder, since.timestamp()))
        return folders

    def begin_anew(self, database: str, marker: str) -> None:
        """Move all that is here to quarantine, with the database and what is remembered of its generation."""
        names = (*FOLDERS, *(f"{database}{part}" for part in ("", "-wal", "-shm")))
        # The marker last: as long as it is here, a start that was cut off is refused and not half done.
        self.quarantine(path for name in (*names, marker) if (path := self.root / name).exists())
        self.make_folders()

    def publish(self, draft: Path, path: Path) -> None:
        """Make a draft the file at ``path``: on the disk first, then there at once or not at all.

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
        """Let another server have the directory."""
        self._lock.close()


def keep_private(root: Path) -> None:
    """Make a data directory, if need be, and keep it from other users: what is made in it from now on, too."""
    os.umask(0o077)  # of this process and of its children, which work in nothing else
    root.mkdir(parents=True, exist_ok=True)
    root.chmod(0o700)
    for path in root.glob("*.sqlite*"):  # of a release that left them open
        path.chmod(0o600)


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it; what cannot go now is garbage for the collector."""
    try:
        path.unlink()
    except OSError:
        shutil.rmtree(path, ignore_errors=True)


def sha256_of(path: Path) -> str:
    """The digest of a file's bytes, in hex."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def is_whole(path: Path, size: int) -> bool:
    """Whether a regular file still has the bytes that it was stored with; a pipe in its place would be waited for."""
    try:
        require_whole(path, size)
    except NotFound:
        return False
    return True


def require_whole(path: Path, size: int) -> os.stat_result:
    """What the system says of such a file.

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
    """Take the lock; whoever only looks whether a server holds it has it for a moment too."""
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
    """See that what was renamed in a directory is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
