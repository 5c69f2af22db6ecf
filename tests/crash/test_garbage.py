"""Garbage is what nothing reaches, and nothing else."""

from __future__ import annotations

import os
import time
from pathlib import Path

from service.store.collect import Collector, collect
from service.store.owners import SERVICE
from service.store.store import Store

from .conftest import Supervising, ended, order, until

HOUR = 3600.0


def old(path: Path) -> Path:
    """The path, made older than any grace."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_dir():
        path.write_bytes(b"left behind")
    os.utime(path, (1.0, 1.0))
    return path


def files(store: Store) -> set[str]:
    found = (path for room in ("blobs", "lifts", "work", "tmp") for path in (store.files.root / room).rglob("*"))
    return {str(path.relative_to(store.files.root)) for path in found if path.is_file()}


def test_what_a_crash_left_goes_and_what_is_needed_stays(store: Store, supervising: Supervising) -> None:
    done, queued = (store.jobs.submit(SERVICE, order(store))[0] for _ in range(2))
    store.jobs.cancel(SERVICE, queued)
    with supervising("answer"):
        ended(store, done)
    waiting = store.jobs.submit(SERVICE, order(store))[0]
    needed = files(store) | {f"work/{waiting}/000000.safetensors"}
    old(store.files.work(waiting) / "000000.safetensors")
    os.utime(store.files.work(waiting), (1.0, 1.0))
    left = [
        old(store.files.blob("ab" * 32, ".ply")),  # published, and the server died before its row
        old(store.files.lift("0" * 32)),
        old(store.files.root / "tmp" / "draft.splats"),
    ]
    for job in (done, queued, "1" * 32):  # ended, canceled, deleted
        old(store.files.work(job) / "000000.safetensors")
        left.append(old(store.files.work(job)))
    assert set(collect(store, time.time() - HOUR)) == set(left)
    assert files(store) == needed
    assert (
        store.assets.get(SERVICE, store.jobs.get(SERVICE, done).splats).path.exists()
        and store.files.lift(done).exists()
    )


def test_nothing_young_and_nothing_in_use_goes(store: Store) -> None:
    store.files.blob("cd" * 32, ".ply").parent.mkdir()
    store.files.blob("cd" * 32, ".ply").write_bytes(b"of this minute")
    with store.files.draft(".splats") as draft, store.files.scratch() as scratch:
        part = draft.with_name(f".{draft.name}.1234.part")  # as a writer keeps it beside its draft
        kept = [old(draft), old(part), old(scratch), store.files.blob("cd" * 32, ".ply")]
        assert collect(store, time.time() - HOUR) == []
        assert all(path.exists() for path in kept)
    assert not draft.exists() and not part.exists() and not scratch.exists()


def test_collector_collects_at_once_and_again(store: Store) -> None:
    collector = Collector(store, every_seconds=0.02, grace_seconds=0.0, quarantine_seconds=HOUR)
    first = old(store.files.lift("0" * 32))
    collector.start()
    until(lambda: not first.exists())
    second = old(store.files.lift("1" * 32))
    until(lambda: not second.exists())
    collector.stop()
