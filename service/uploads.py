"""Uploads: receive a body, count and digest it, and check the file in a child process."""

from __future__ import annotations

import contextlib
import hashlib
import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, Generic, TypeVar

from liftcore import errors
from liftcore.errors import InvalidInput, InvalidLift, NotFound
from liftcore.files import require_pairs
from service.child import error_of
from service.errors import DigestMismatch, ProcessDied, TooLarge
from service.models import AssetKind, UploadKind
from service.sandbox import SandboxLimits, run_sandboxed
from service.store.assets import ALL, SHOWN_CHARACTERS, AssetRecord, CheckedUpload
from service.store.files import is_whole
from service.store.lifts import FinishedLift, LiftRecord, order_of
from service.store.owners import Owner
from service.store.store import Store

LIFT = "lift"

# Error class of a malformed file, by kind.
INVALID: dict[UploadKind, type[InvalidInput]] = {
    kind: getattr(errors, f"Invalid{kind.capitalize()}") for kind in (*AssetKind, LIFT)
}

STEP = 4 << 20  # bytes between two checks of the free space
CHECK_BASE_BYTES, CHECK_FACTOR = 1 << 30, 16  # private memory of a check: a reader holds several copies of a file
HINTS: dict[UploadKind, str] = {AssetKind.FEATURES: "several feature packs may make one lift, so features can be cut"}

log = logging.getLogger(__name__)


def require_size(kind: UploadKind, count: int, limit: int) -> None:
    """Require that a body of that size is allowed.

    Raises:
        TooLarge: it may not.
    """
    if count > limit:
        raise TooLarge("body", expected=f"at most {limit} bytes", got="more", hint=HINTS.get(kind, ""))


Record = TypeVar("Record", AssetRecord, LiftRecord)


class Intake(ABC, Generic[Record]):
    """One upload. All methods work on files: call them in threads, one at a time.

    Args:
        store: that takes it.
        owner: for whom.
        limit: bytes that may come.
    """

    def __init__(self, store: Store, owner: Owner, kind: UploadKind, limit: int) -> None:
        self._store = store
        self._owner = owner
        self._kind: UploadKind = kind
        self._limit = limit
        self._received_bytes = self._permitted_bytes = 0
        self._digest = hashlib.sha256()
        self._open, self._is_closed, self._lock = contextlib.ExitStack(), False, Lock()
        self._draft: Path | None = None
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Create the draft, if there is space.

        Raises:
            NoSpace, OverQuota: there may not.
        """
        self._store.files.require_room()
        self._store.assets.require_quota(self._owner)
        with self._lock:  # a cancelled request is closed while its thread may still be here
            if not self._is_closed:
                self._draft = self._open.enter_context(self._store.files.draft(f".{self._kind}"))
                self._file = self._open.enter_context(self._draft.open("wb"))

    def close(self) -> None:
        """Remove the draft; `open` then makes none."""
        with self._lock:
            self._is_closed = True
            self._open.close()

    def feed(self, chunk: bytes) -> None:
        """Take the next bytes of the body.

        Raises:
            TooLarge: there are more than may come.
            NoSpace, OverQuota: they may not be stored.
        """
        assert self._file is not None
        self._received_bytes += len(chunk)
        require_size(self._kind, self._received_bytes, self._limit)
        if self._received_bytes > self._permitted_bytes:  # a body may have no declared length
            self._store.files.require_room(len(chunk))
            self._store.assets.require_quota(self._owner, self._received_bytes)
            self._permitted_bytes = self._received_bytes + STEP
        self._digest.update(chunk)
        self._file.write(chunk)

    def finish(self, declared_digest: str | None) -> Record | None:
        """Finish after the last byte: check the digest and the file, and store it.

        Args:
            declared_digest: the sha256 in hex that the client sent, if any.

        Returns:
            The asset, if its owner already has these bytes.

        Raises:
            DigestMismatch: the bytes are others.
        """
        assert self._file is not None
        self._file.flush()
        digest = self._digest.hexdigest()
        if declared_digest is not None and digest != declared_digest.lower():
            raise DigestMismatch("sha256", expected=declared_digest, got=digest, hint="upload the file again")
        return self._find_same(digest)

    def check(self, limits: SandboxLimits) -> CheckedUpload:
        """Check the whole draft in a child process.

        Raises:
            InvalidInput, ProcessDied, ServiceUnavailable: as `check` has it.
            NotFound: the asset to check it with is missing.
        """
        assert self._draft is not None
        with self._store.files.scratch() as scratch:
            report = check(self._kind, self._draft, scratch, limits, *self._files_beside())
        digest = self._digest.hexdigest()
        return CheckedUpload(self._draft, self._kind, digest, report.suffix, report.counts, report.warnings)

    def _files_beside(self) -> tuple[Path, ...]:
        """Return other files that the check needs."""
        return ()

    @abstractmethod
    def _find_same(self, digest: str) -> Record | None: ...

    @abstractmethod
    def keep(self, upload: CheckedUpload) -> tuple[Record, bool]:
        """Store the checked file; return True if its owner did not have it before.

        Raises:
            OverQuota: it would be more than the owner may store.
            NotFound, InvalidLift: it does not go with what is here.
        """


class AssetIntake(Intake[AssetRecord]):
    """The upload of an asset."""

    def _find_same(self, digest: str) -> AssetRecord | None:
        record = self._store.assets.find(self._owner, f"sha256:{digest}", limit=SHOWN_CHARACTERS)
        return record if record is not None and record.kind == self._kind and record.is_complete else None

    def keep(self, upload: CheckedUpload) -> tuple[AssetRecord, bool]:
        """Store it as an asset."""
        return self._store.assets.add(self._owner, upload)


class LiftIntake(Intake[LiftRecord]):
    """Upload of a lift that was made elsewhere. Its splats and cameras must be here, under their digests.

    Args:
        cameras: an asset that has the lift's cameras, in place of that digest: of a folder there is no such file.
    """

    def __init__(self, *arguments: Any, cameras: str | None = None) -> None:
        super().__init__(*arguments)
        self._cameras = cameras

    def _files_beside(self) -> tuple[Path, ...]:
        if self._cameras is None:
            return ()
        return (self._store.assets.get(self._owner, self._cameras, AssetKind.CAMERAS).path,)

    def _find_same(self, digest: str) -> LiftRecord | None:
        record = self._store.lifts.of_file(self._owner, digest)
        return record if record is not None and is_whole(record.path, record.bytes) else None

    def keep(self, upload: CheckedUpload) -> tuple[LiftRecord, bool]:
        """Store it as a lift."""
        counts, assets = upload.counts, self._store.assets
        order = order_of(counts["metadata"])
        order = order if self._cameras is None else replace(order, cameras=self._cameras)
        splats = assets.get(self._owner, order.splats, AssetKind.SPLATS)
        if splats.counts["splats"] != counts["count"]:
            got = f"{counts['count']} for {splats.counts['splats']} splats"
            raise InvalidLift("lift", expected="a row for each splat", got=got)
        try:
            cameras = assets.get(self._owner, order.cameras, AssetKind.CAMERAS, limit=ALL)
        except NotFound as error:
            hint = "PUT its file of cameras first; in place of a folder a zip of it, named here as ?cameras=ID"
            raise NotFound(error.argument, expected=error.expected, got=error.got, hint=hint) from None
        require_pairs(counts["metadata"]["views"], cameras.counts["names"])
        packs = tuple(pack for pack in order.features if assets.find(self._owner, pack) is not None)
        lift = FinishedLift(upload.draft, upload.sha256, counts["count"], counts["channels"], counts["metadata"])
        return self._store.lifts.take(self._owner, replace(order, features=packs), lift), True


@dataclass(frozen=True)
class Report:
    """Description of a valid file."""

    suffix: str  # of the stored file, such as .ply
    counts: dict[str, Any]
    warnings: list[str]


def check(kind: UploadKind, path: Path, scratch: Path, limits: SandboxLimits, *files_beside: Path) -> Report:
    """Check a whole file in a child process, which writes to ``scratch`` and ends with this process.

    Args:
        files_beside: of a lift, cameras that must see the same as its own.

    Raises:
        InvalidInput: the file is malformed, or it takes more time or memory than it may.
        ProcessDied: the process did not get as far as opening the file.
        ServiceUnavailable: as `run_sandboxed` has it.
    """
    memory = min(limits.memory_bytes, CHECK_BASE_BYTES + CHECK_FACTOR * sum(map(_size, (path, *files_beside))))
    arguments = [kind, str(path), *map(str, files_beside)]
    result = run_sandboxed("service.tasks.check", arguments, scratch, replace(limits, memory_bytes=memory))
    if result is None:
        raise too_slow(kind, limits)
    if result.last["event"] == "valid":
        return Report(suffix=result.last["suffix"], counts=result.last["counts"], warnings=result.last["warnings"])
    if result.last["event"] == "invalid":
        raise error_of(result.last["fault"])
    log.error("the check of %s ended with %s: %s", kind, result.returncode, result.trace)
    if result.last["event"] == "ready":
        # It had begun to read, so the file is to blame.
        raise INVALID[kind](
            kind, expected="a file that its reader can take", got=f"one that ended it with {result.returncode}",
            hint="it may be broken, or need more memory than an upload may take",
        )  # fmt: skip
    raise ProcessDied("check", expected="a process that starts", got=f"one that ended with {result.returncode}")


def too_slow(kind: UploadKind, limits: SandboxLimits) -> InvalidInput:
    """Return the error for a file that takes too long to read."""
    return INVALID[kind](
        kind, expected=f"a file that is read within {limits.seconds:g} s", got="one that takes longer"
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
