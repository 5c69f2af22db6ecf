"""One attempt at a job: a child process, the conversation with it, and what comes of it."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liftcore.errors import SplatliftError
from service.child import fault_of
from service.errors import OverLimit
from service.jobs.leftovers import mark
from service.jobs.limits import JobLimits
from service.jobs.pace import StagePace
from service.jobs.process import JobProcess
from service.models import ENDED, JobKind, JobState
from service.store.assets import kernel_of
from service.store.jobs import JobRecord, labels_of
from service.store.lifts import FinishedLift
from service.store.store import Store
from service.store.tradeoffs import FinishedTradeoff

TICK_SECONDS = 0.2  # how soon a cancel, a stop or a limit is seen
RENEWALS = 4  # of a lease, in the time that it lasts
BUSY_SECONDS = 0.5  # of a processor: a silent child that takes so much in its lease is alive
CHILD = (sys.executable, "-m", "service.jobs.child")
DRAFTS = {JobKind.LIFT: ".safetensors", JobKind.TRADEOFF: ".png"}  # what a child writes

log = logging.getLogger(__name__)


@dataclass
class _Heard:
    """What the child has said so far, and when."""

    answer: dict[str, Any] | None = None  # its last word
    stage: str = ""
    begun: float = field(default_factory=time.monotonic)
    lately: float = field(default_factory=time.monotonic)  # the last sign of life
    spent: float | None = None  # processor seconds when it was found silent
    looked: float = field(default_factory=time.monotonic)  # when we last listened


class Attempt:
    """Runs in a thread of the supervisor, which is the only one that changes its job."""

    def __init__(self, job: JobRecord, store: Store, limits: JobLimits, command: Sequence[str] = CHILD) -> None:
        self._job = job
        self._store = store
        self._limits = limits
        self._command = command
        self._pace = StagePace()
        self._renewed = time.monotonic()

    def run(self, stopping: threading.Event) -> None:
        """From the start of the child to the end of its process group, and the state that follows from it."""
        files = self._store.files
        with files.draft(DRAFTS[self._job.kind]) as draft, files.scratch() as scratch:
            order = scratch / "order.json"
            order.write_text(json.dumps(self._order(draft)), encoding="utf-8")
            environment = mark(self._job.id) | {"TMPDIR": str(scratch)}
            heard = _Heard()
            self._log(f"attempt {self._job.attempt} begins{self._asked()}{self._kept()}")
            with JobProcess([*self._command, str(order)], environment, self._job.id) as process:
                why = self._follow(process, heard, stopping)
                status = process.end()
            self._settle(draft, heard, why or _told(status), stopping)
        if self._store.attempts.state(self._job.id) in ENDED:
            files.forget_work(self._job.id)

    def _follow(self, process: JobProcess, heard: _Heard, stopping: threading.Event) -> str | SplatliftError | None:
        """Listen until the child has ended or must end; why it must, None when it ended by itself."""
        while True:
            ended = process.ended()  # before listening, so that its last words are heard
            for message in process.listen(0 if ended else TICK_SECONDS):
                self._take(message, heard)
            if ended:
                return None
            why = self._why_end(process, heard)
            if why is not None or stopping.is_set():
                return why or "the server stops"
            heard.looked = time.monotonic()

    def _take(self, message: dict[str, Any], heard: _Heard) -> None:
        self._alive(heard)
        if message["event"] == "progress":
            if message["stage"] != heard.stage:
                heard.stage = message["stage"]
                parts = f": {message['total']} {message['unit']}" if message["total"] > 1 else ""
                self._log(f"{heard.stage}{parts}")
            self._store.attempts.advance(self._job.id, self._job.attempt, self._pace.progress(message))
        elif message["event"] == "plan":
            self._store.attempts.plan(self._job.id, self._job.attempt, message["plan"])
        elif message["event"] != "beat":
            heard.answer = message

    def _alive(self, heard: _Heard) -> None:
        heard.lately, heard.spent = time.monotonic(), None
        if heard.lately - self._renewed > self._limits.lease_seconds / RENEWALS:
            self._renewed = heard.lately
            self._store.attempts.renew(self._job.id, self._job.attempt, self._limits.lease_seconds)

    def _why_end(self, process: JobProcess, heard: _Heard) -> str | SplatliftError | None:
        now, limits, kind = time.monotonic(), self._limits, self._job.kind
        if now - heard.looked > limits.lease_seconds / 2:
            heard.lately = now  # it was the server that slept: the child has a lease from now on
        if now - heard.lately > limits.lease_seconds / RENEWALS:
            self._see_whether_it_works(process, heard)
        if self._store.attempts.state(self._job.id) is not JobState.RUNNING:
            return "it is canceled"
        if now - heard.lately > limits.lease_seconds:
            return f"its process was silent for {limits.lease_seconds:g} s"
        if now - heard.begun > limits.seconds:
            return OverLimit(
                kind, expected=f"a {kind} that takes at most {limits.seconds:g} s", got="one that takes more"
            )
        if limits.memory_bytes is not None and process.private_bytes() > limits.memory_bytes:
            return OverLimit(
                kind, expected=f"a {kind} that takes at most {limits.memory_bytes} bytes of memory",
                got="one that takes more", hint="fewer views, channels or splats take less",
            )  # fmt: skip
        return None

    def _see_whether_it_works(self, process: JobProcess, heard: _Heard) -> None:
        """One call into a library (HDBSCAN on many splats) may keep all threads of a child from speaking."""
        spent = process.processor_seconds()
        if heard.spent is None or spent < heard.spent:  # less when one that it had started has ended
            heard.spent = spent
        elif spent - heard.spent > BUSY_SECONDS:
            self._alive(heard)

    def _settle(self, draft: Path, heard: _Heard, why: str | SplatliftError, stopping: threading.Event) -> None:
        """No process of this attempt is left; what becomes true now stays true."""
        job, attempts, answer = self._job, self._store.attempts, heard.answer or {"event": "none"}
        if answer["event"] == "done":
            if not self._keep(draft, answer):
                attempts.lose(job.id, job.attempt, "it is canceled")
        elif answer["event"] == "fault":
            attempts.fail(job.id, job.attempt, answer["fault"])
        elif isinstance(why, SplatliftError):
            attempts.fail(job.id, job.attempt, fault_of(why))
        elif stopping.is_set():
            attempts.release(job.id, job.attempt)
        else:
            log.warning("job %s, attempt %d: %s", job.id, job.attempt, why)
            attempts.lose(job.id, job.attempt, why)

    def _keep(self, draft: Path, answer: dict[str, Any]) -> bool:
        """Make the result true, and the job succeeded with it; False when the attempt may not."""
        job = self._job
        if job.kind is JobKind.TRADEOFF:
            found = FinishedTradeoff(answer["document"], answer["page"], draft.read_bytes())
            return self._store.tradeoffs.finish(job.id, job.attempt, found)
        made = FinishedLift(draft, answer["sha256"], answer["count"], answer["channels"], answer["metadata"])
        return self._store.lifts.finish(job.id, job.attempt, made)

    def _log(self, text: str) -> None:
        self._store.attempts.log(self._job.id, self._job.attempt, text)

    def _asked(self) -> str:
        return f", asked for by request {self._job.request_id}" if self._job.request_id else ""

    def _kept(self) -> str:
        blocks = len(list(self._store.files.work(self._job.id).glob("*.safetensors")))
        return f", {blocks} blocks of walked views are kept" if blocks else ""

    def _order(self, draft: Path) -> dict[str, Any]:
        job, files = self._job, self._store.files
        assets = [self._store.assets.get(name) for name in (job.splats, job.cameras, *job.features)]
        labels = [self._store.assets.get(*named) for named in labels_of(job.parameters)]
        return {
            "kind": job.kind,
            "parameters": job.parameters,
            "splats": str(assets[0].path),
            "kernel": kernel_of(assets[0], job.settings),  # to compile for
            "cameras": str(assets[1].path),
            "features": [str(asset.path) for asset in assets[2:]],
            "labels": {str(asset.kind): str(asset.path) for asset in labels},
            "settings": job.settings,
            "threads": self._limits.threads,
            "work": str(files.work(job.id)),
            "checkpoint_seconds": self._limits.checkpoint_seconds,
            "output": str(draft),
            "file_names": {str(asset.path): asset.file_name for asset in assets},
            "names": {str(asset.path): f"{asset.kind} {asset.id}" for asset in (*assets, *labels)},
        }


def _told(status: int) -> str:
    return f"its process ended with signal {-status}" if status < 0 else f"its process ended with status {status}"
