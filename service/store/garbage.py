"""Garbage: files that nothing in the database reaches and no running work needs."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from pathlib import Path

from service.store.store import Store
from service.wire import ENDED

log = logging.getLogger(__name__)


def collect(store: Store, older_than: float) -> list[Path]:
    """Remove what crashes left behind: blobs and lifts without a row, drafts without a writer, work of ended jobs.

    Args:
        store: whose files are looked through.
        older_than: seconds since 1970; what was changed later stays.

    Returns:
        What was removed.
    """
    removed = store.assets.collect(older_than) + store.lifts.collect(older_than)
    for path in _unused_work(store) + store.files.left_over():
        if _changed(path) < older_than:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
            removed.append(path)
    return removed


def _unused_work(store: Store) -> list[Path]:
    """Folders of jobs that have ended or were deleted. A job that has ended never runs again."""
    folders = (store.files.root / "work").iterdir()
    return [folder for folder in folders if (store.attempts.state(folder.name) or "deleted") in {*ENDED, "deleted"}]


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:  # its owner was quicker
        return float("inf")


class Collector:
    """A thread that collects at start-up and now and then."""

    def __init__(self, store: Store, *, every_seconds: float, grace_seconds: float) -> None:
        self._store = store
        self._every = every_seconds
        self._grace = grace_seconds
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="collector", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; returns when the thread has."""
        self._stopping.set()
        self._thread.join()

    def _loop(self) -> None:
        while True:
            try:
                for path in collect(self._store, time.time() - self._grace):
                    log.info("removed %s, which nothing refers to", path)
            except Exception:  # a full disk today must not stop the collection of tomorrow
                log.exception("the collection of garbage stumbled")
            if self._stopping.wait(self._every):
                return
