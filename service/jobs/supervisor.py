"""The supervisor: takes queued jobs one after the other and runs each in a child process."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any

from liftcore.errors import SplatliftError
from service.errors import Crashed
from service.faults import fault_of
from service.jobs.pace import Pace
from service.jobs.process import JobProcess
from service.store.jobs import JobRecord
from service.store.lifts import FinishedLift
from service.store.store import Store

IDLE_SECONDS = 5.0  # a forgotten wake-up costs at most this

log = logging.getLogger(__name__)


class Supervisor:
    """One thread that owns the running job. Only it changes a job after it was submitted."""

    def __init__(self, store: Store, *, threads: int | None) -> None:
        self._store = store
        self._threads = threads
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._process: JobProcess | None = None
        self._process_lock = threading.Lock()
        self._thread = threading.Thread(target=self._loop, name="supervisor", daemon=True)

    def start(self) -> None:
        """Put back what a dead server left running, then begin to take jobs."""
        self._store.jobs.requeue_orphans()
        self._thread.start()

    def wake(self) -> None:
        """Say that there is a new job."""
        self._wake.set()

    def stop(self) -> None:
        """End the running child and put its job back in line; returns when no child is left."""
        self._stopping.set()
        self._wake.set()
        with self._process_lock:
            process = self._process
        if process is not None:
            process.stop()
        self._thread.join()

    def _loop(self) -> None:
        while not self._stopping.is_set():
            self._wake.clear()
            try:
                job = self._store.jobs.claim()
                if job is not None:
                    self._run(job)
                    continue
            except Exception:  # the thread must outlive a full disk or a locked database
                log.exception("the supervisor stumbled")
            self._wake.wait(IDLE_SECONDS)

    def _run(self, job: JobRecord) -> None:
        files = self._store.files
        try:  # around the draft too: a full disk must not leave the job running for ever
            with files.draft(".safetensors") as draft, files.scratch() as scratch:
                last, status = self._converse(job, draft, scratch)
                self._settle(job, draft, last, status)
        except Exception:
            log.exception("job %s could not be run", job.id)
            self._fail(job, Crashed("job", expected="a process that runs", got="an error of the server"))

    def _converse(self, job: JobRecord, draft: Path, scratch: Path) -> tuple[dict[str, Any], int]:
        """Run the child to its end; its last message that was not progress, and its exit status."""
        with self._process_lock:
            if self._stopping.is_set():
                return {"event": "nothing"}, 0
            self._process = process = JobProcess(self._order(job, draft), scratch)
        last: dict[str, Any] = {"event": "nothing"}
        pace = Pace()
        try:
            for message in process.messages():
                if message["event"] == "progress":
                    self._store.jobs.advance(job.id, job.attempt, pace.progress(message))
                else:
                    last = message
        except BaseException:
            process.kill()
            raise
        finally:
            status = process.wait()
            with self._process_lock:
                self._process = None
        return last, status

    def _settle(self, job: JobRecord, draft: Path, last: dict[str, Any], status: int) -> None:
        if last["event"] == "done":
            made = FinishedLift(draft, last["sha256"], last["count"], last["channels"], last["metadata"])
            self._store.lifts.finish(job.id, job.attempt, made)
        elif last["event"] == "fault":
            self._store.jobs.fail(job.id, job.attempt, last["fault"])
        elif self._stopping.is_set():
            self._store.jobs.release(job.id, job.attempt)
        else:
            how = f"signal {-status}" if status < 0 else f"exit status {status}"
            self._fail(
                job,
                Crashed(
                    "job",
                    expected="an answer from the job's process",
                    got=f"none: it ended with {how}",
                    hint="signal 9 is mostly a lack of memory; the server's log has what the process printed",
                ),
            )

    def _fail(self, job: JobRecord, error: SplatliftError) -> None:
        self._store.jobs.fail(job.id, job.attempt, fault_of(error))

    def _order(self, job: JobRecord, draft: Path) -> dict[str, Any]:
        assets = [self._store.assets.get(name) for name in (job.splats, job.cameras, *job.features)]
        return {
            "splats": str(assets[0].path),
            "cameras": str(assets[1].path),
            "features": [str(asset.path) for asset in assets[2:]],
            "settings": job.settings,
            "threads": self._threads,
            "output": str(draft),
            "names": {str(asset.path): f"{asset.kind} {asset.id}" for asset in assets},
        }
