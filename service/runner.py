"""Threads that run queued jobs, each in a child. Only they change a job after it was submitted or canceled."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from liftcore.errors import SplatliftError
from service.errors import REQUEST_ID, Busy, NoSpace, ProcessDied, fault_of
from service.models import FINAL_STATES, Job
from service.process import Children, Message
from service.settings import ServiceSettings
from service.store import MAX_ATTEMPTS, SERVICE, Owner, Store, assets_of

IDLE_SECONDS = 5.0  # the longest delay after a missed wake-up
RETRY_SECONDS = 1.0  # between attempts to write to the database, or to find free disk
OUTPUTS = {"lift": "output.safetensors", "tradeoff": "output.png"}
TRANSIENT_ERRORS = (OSError, sqlite3.OperationalError, NoSpace, Busy)  # of the server: a full disk, a locked database

log = logging.getLogger(__name__)


class Runner:
    """Runs jobs until it is stopped."""

    def __init__(self, store: Store, children: Children, settings: ServiceSettings) -> None:
        self._store, self._children, self._settings = store, children, settings
        self._work = threading.Semaphore(0)
        self.attempts = 0  # that have ended
        self._threads = [
            threading.Thread(target=self._loop, name=f"runner-{number}", daemon=True)
            for number in range(settings.parallel_jobs)
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def wake(self) -> None:
        """Look for a job now."""
        self._work.release()

    def is_alive(self) -> bool:
        """Return True if all threads live."""
        return all(thread.is_alive() for thread in self._threads)

    def stop(self) -> None:
        """End the running children, whose jobs go back in line; return when no child is left."""
        self._children.stop()
        for thread in self._threads:
            self.wake()
            if thread.ident is not None:
                thread.join()

    def _loop(self) -> None:
        stopping = self._children.stopping
        while not stopping.is_set():
            job = None
            try:
                self._store.require_room()  # a checkpoint of the next job may fill the disk
                job = self._store.claim()
                if job is not None:
                    self._run(job)
                    continue
            except TRANSIENT_ERRORS as error:
                log.warning("job %s waits for the server: %s", job and job.id, error)
                stopping.wait(RETRY_SECONDS)
            except Exception:  # the thread must survive
                log.exception("job %s could not be run", job and job.id)
                stopping.wait(RETRY_SECONDS)
            self._work.acquire(timeout=IDLE_SECONDS if job is None else 0)

    def _run(self, job: Job) -> None:
        """Run one attempt at a job, and store how it ended, also after a long time with a full disk."""
        token, start = REQUEST_ID.set(job.request_id), time.monotonic()
        log.info("job %s, attempt %d begins", job.id, job.attempt)
        try:
            with self._store.scratch() as scratch:
                draft = scratch / OUTPUTS[job.kind]
                settle = self._attempt(job, scratch, draft)
                self._until_committed(settle)
            rows = self._store.rows("SELECT state FROM jobs WHERE id = :id", id=job.id)
            state = rows[0]["state"] if rows else "deleted"  # by a client that was faster
            if state in (*FINAL_STATES, "deleted"):
                self._store.forget_work(job.id)
            log.info("job %s, attempt %d: %s after %.3f s", job.id, job.attempt, state, time.monotonic() - start)
        except Exception:
            self._until_committed(lambda: self._store.end(job))
            raise
        finally:
            self.attempts += 1
            REQUEST_ID.reset(token)

    def _attempt(self, job: Job, scratch: Path, draft: Path) -> Callable[[], None]:
        """Run the child to the end of its process group; return what is to be stored."""
        store, pace, messages = self._store, StagePace(), list[Message]()

        def take(message: Message) -> None:
            messages[:] = [message]
            try:
                for kind, data in message.items():
                    store.note(job.id, kind, pace.progress(data) if kind == "progress" else data)
            except TRANSIENT_ERRORS as error:  # the next one will be stored
                log.warning("the progress of job %s cannot be stored: %s", job.id, error)

        def why_end() -> str:
            try:
                return "" if store.job(SERVICE, job.id).state == "running" else "it is canceled"
            except TRANSIENT_ERRORS:  # if the database cannot be read, the job cannot have been canceled
                return ""

        try:
            order = order_of(dict(job), store, SERVICE, self._settings)
        except SplatliftError as error:
            fault = fault_of(error)
            return lambda: store.end(job, fault)
        work, settings = str(store.work(job.id)), self._settings
        order["names"][work] = "the job's folder"
        order |= {
            "task": job.kind, "kind": job.kind, "scratch": str(scratch), "output": str(draft), "work": work,
            "parameters": job.parameters, "threads": settings.job_threads,
        }  # fmt: skip
        ending = self._children.run(order, settings.job_seconds, take, why_end)
        if ending.was_killed and not messages:  # it died as a spare, with the child before it: that is no attempt
            ending = self._children.run(order, settings.job_seconds, take, why_end)
        last = ending.last
        if last is not None and "result" in last:
            return lambda: store.finish(job, last["result"], draft)
        if last is not None:
            # A full disk is the server's fault: the job goes back in line.
            return lambda: store.end(job, None if last["fault"]["status"] == NoSpace.status else last["fault"])
        if self._children.stopping.is_set():
            return lambda: store.end(job)
        log.warning("job %s, attempt %d: %s", job.id, job.attempt, ending.reason)
        crash = ProcessDied(
            "job", expected="an answer from the job's process",
            got=f"none in {MAX_ATTEMPTS} attempts; last: {ending.reason}",
            hint="signal 9 is mostly a lack of memory; the server's log has what the process printed",
        )  # fmt: skip
        return lambda: store.end(job, fault_of(crash), retries=True)

    def _until_committed(self, settle: Callable[[], None]) -> None:
        """Store the end of an attempt. A stop ends the tries; the next start puts the job back in line."""
        while True:
            try:
                return settle()
            except TRANSIENT_ERRORS as error:
                log.warning("the end of a job cannot be stored yet: %s", error)
                if self._children.stopping.wait(RETRY_SECONDS):
                    return None


def order_of(fields: dict[str, Any], store: Store, owner: Owner, settings: ServiceSettings) -> dict[str, Any]:
    """Return a child's order by the fields of a job: its files, and what clients call them."""
    records = [store.asset(owner, *asset) for asset in assets_of(fields)]
    end = 2 + len(fields["features"])
    splats, cameras, *packs = records[:end]
    return {
        "splats": str(splats.file), "kernel": splats.kernel(fields["settings"]), "cameras": str(cameras.file),
        "features": [str(pack.file) for pack in packs],
        "labels": {item.kind: str(item.file) for item in records[end:]},
        "settings": fields["settings"], "engine": settings.engine,
        "file_names": {str(item.file): item.download_name for item in records[:end]},
        "names": {str(item.file): item.client_name for item in records},
    }  # fmt: skip


class StagePace:
    """Estimate of the remaining seconds of a stage, from its speed so far."""

    def __init__(self) -> None:
        self._stage, self._begin, self._completed_at_begin = "", 0.0, 0

    def progress(self, message: Message) -> Message:
        """Return the message as `service.models.Progress` has it."""
        now, completed, eta = time.monotonic(), message["completed"], None
        if message["stage"] != self._stage:
            self._stage, self._begin, self._completed_at_begin = message["stage"], now, completed
        if (advance := completed - self._completed_at_begin) > 0:
            eta = round((now - self._begin) / advance * (message["total"] - completed), 2)
        return {**message, "eta_s": eta}
