"""What jobs promise while their processes die, freeze, overeat or are canceled."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from service.errors import Conflict
from service.jobs import leftovers
from service.jobs.leftovers import mark
from service.models import JobState
from service.store.attempts import MAX_ATTEMPTS
from service.store.events import EventKind
from service.store.files import DataDirectory
from service.store.lifts import FinishedLift
from service.store.store import Store

from .conftest import Supervising, alive, ended, order, until

LEASE = 60.0
SHORT_LEASE = 3.0  # for children that are silent on purpose; others begin and speak within it on a busy machine


def submit(store: Store, **settings: Any) -> str:
    return store.jobs.submit(order(store, **settings))[0]


def states(store: Store, job: str) -> list[str]:
    return [event.data["state"] for event in store.events.after(job, 0) if event.kind is EventKind.STATE]


def log_of(store: Store, job: str) -> str:
    lines = [event.data["line"] for event in store.events.after(job, 0) if event.kind is EventKind.LOG]
    return "\n".join(lines)


def pids(store: Store, job: str) -> list[int]:
    path = store.files.work(job) / "attempts"
    return [int(pid) for pid in path.read_text().split()] if path.exists() else []


def test_child_that_dies_without_a_word_is_tried_three_times_then_failed(
    store: Store, supervising: Supervising
) -> None:
    job = submit(store)
    with supervising("die"):
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.FAILED, MAX_ATTEMPTS)
    assert found.problem is not None and "signal 9" in found.problem["got"] and "3 attempts" in found.problem["got"]
    assert states(store, job) == ["queued", *["running", "queued"] * 2, "running", "failed"]


def test_job_whose_child_died_succeeds_in_its_next_attempt(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("die_once"):
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.SUCCEEDED, 2)
    assert states(store, job) == ["queued", "running", "queued", "running", "succeeded"]
    until(lambda: not store.files.work(job).exists())  # what it went on from is removed


def test_plan_of_the_latest_attempt_stands(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("die_once"):
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.SUCCEEDED, 2)
    assert found.plan == {"summary": ["one splat"], "warnings": [], "splats": 1}
    [event] = [event for event in store.events.after(job, 0) if event.kind is EventKind.PLAN]
    assert event.data == found.plan


def test_plan_outlives_the_attempt_that_made_it(store: Store) -> None:
    job = submit(store)
    assert store.attempts.claim(LEASE) is not None
    store.attempts.plan(job, 1, {"summary": []})
    store.attempts.lose(job, 1, "it died")
    assert store.attempts.claim(LEASE) is not None
    assert store.jobs.get(job).plan == {"summary": []}  # until this one has planned


def test_child_that_is_stopped_past_its_lease_is_fenced(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("stop_once", lease_seconds=SHORT_LEASE):
        until(lambda: pids(store, job))
        (stale,) = pids(store, job)
        found = ended(store, job)
        assert not alive(stale)  # there is nothing left to continue
        with pytest.raises(ProcessLookupError):
            os.kill(stale, signal.SIGCONT)
    assert (found.state, found.attempt) == (JobState.SUCCEEDED, 2)
    assert "silent" in log_of(store, job)


def test_silent_child_that_computes_keeps_its_lease(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("toil", lease_seconds=SHORT_LEASE):
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.SUCCEEDED, 1)


def test_draft_of_a_stale_attempt_never_becomes_the_lift(store: Store) -> None:
    job = submit(store)
    for attempt in (1, 2):
        claimed = store.attempts.claim(LEASE)
        assert claimed is not None and claimed.attempt == attempt
        if attempt == 1:
            store.attempts.lose(job, 1, "it was silent")
    with store.files.draft(".safetensors") as draft:
        draft.write_bytes(b"stale")
        assert not store.lifts.finish(job, 1, FinishedLift(draft, "0" * 64, 1, 1, {}))
        assert draft.read_bytes() == b"stale" and not store.files.lift(job).exists()
    store.attempts.fail(job, 1, {"kind": "crashed"})
    store.attempts.advance(job, 1, {"stage": "old"})
    store.attempts.plan(job, 1, {"summary": ["old"]})
    store.attempts.log(job, 1, "old")
    assert store.attempts.renew(job, 1, LEASE) is None
    found = store.jobs.get(job)
    assert (found.state, found.attempt, found.progress, found.plan) == (JobState.RUNNING, 2, None, None)
    assert "old" not in log_of(store, job)
    assert EventKind.PLAN not in {event.kind for event in store.events.after(job, 0)}


def test_server_that_slept_gives_its_children_a_lease(store: Store, supervising: Supervising) -> None:
    """What sleeps is the thread that listens, as when the whole server was stopped: its child beats all the while."""
    job = submit(store)
    read = store.attempts.state

    def slow(name: str) -> JobState | None:
        store.attempts.__dict__.pop("state")
        time.sleep(1.5 * SHORT_LEASE)
        return read(name)

    with supervising("slowly", lease_seconds=SHORT_LEASE):
        store.attempts.__dict__["state"] = slow
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.SUCCEEDED, 1)


def test_canceled_job_has_no_live_process_and_cancel_takes_less_than_five_seconds(
    store: Store, supervising: Supervising
) -> None:
    job = submit(store)
    with supervising("hang"):
        grandchild = store.files.work(job) / "grandchild"
        until(lambda: grandchild.exists() and grandchild.read_text())
        processes = [*pids(store, job), int(grandchild.read_text())]
        assert all(alive(pid) for pid in processes)
        begun = time.monotonic()
        assert store.attempts.cancel(job)
        until(lambda: store.jobs.get(job).state is JobState.CANCELED)
        assert not any(alive(pid) for pid in processes)
        assert time.monotonic() - begun < 5.0  # the promise of POST /jobs/{job}/cancel
        assert not store.attempts.cancel(job)  # again does no harm
    assert states(store, job) == ["queued", "running", "canceling", "canceled"]


def test_queued_job_is_canceled_at_once_and_never_runs(store: Store, supervising: Supervising) -> None:
    job, other = submit(store), submit(store)
    assert store.attempts.cancel(job)
    assert store.jobs.get(job).state is JobState.CANCELED
    with supervising("answer"):
        assert ended(store, other).state is JobState.SUCCEEDED
    assert states(store, job) == ["queued", "canceled"]


def test_job_that_succeeded_cannot_be_canceled(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("answer"):
        ended(store, job)
    with pytest.raises(Conflict, match="succeeded"):
        store.attempts.cancel(job)
    assert store.jobs.get(job).state is JobState.SUCCEEDED


def test_lift_that_is_done_when_its_job_is_canceling_is_dropped(store: Store) -> None:
    job = submit(store)
    assert store.attempts.claim(LEASE) is not None
    store.attempts.cancel(job)
    with store.files.draft(".safetensors") as draft:
        draft.write_bytes(b"too late")
        assert not store.lifts.finish(job, 1, FinishedLift(draft, "0" * 64, 1, 1, {}))
    store.attempts.lose(job, 1, "it is canceled")
    assert store.jobs.get(job).state is JobState.CANCELED and store.lifts.find(job) is None


@pytest.mark.parametrize(
    ("behaviour", "limit", "word"),
    [
        ("hang", {"seconds": 0.5}, "0.5 s"),
        ("eat", {"memory_bytes": 200 << 20}, "memory"),
        ("feed", {"memory_bytes": 200 << 20}, "memory"),
    ],
)
def test_job_beyond_a_limit_is_ended_once_and_told(
    store: Store, supervising: Supervising, behaviour: str, limit: dict[str, Any], word: str
) -> None:
    job = submit(store)
    with supervising(behaviour, **limit):
        found = ended(store, job)
    assert (found.state, found.attempt) == (JobState.FAILED, 1)
    assert found.problem is not None and found.problem["kind"] == "over-limit" and word in found.problem["expected"]


def test_lifts_run_side_by_side_when_the_operator_says_so(store: Store, supervising: Supervising) -> None:
    jobs = [submit(store), submit(store)]
    with supervising("meet", parallel=2):
        assert [ended(store, job).state for job in jobs] == [JobState.SUCCEEDED] * 2


def test_orderly_stop_leaves_no_process_and_does_not_use_up_attempts(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    for _ in range(MAX_ATTEMPTS + 1):
        with supervising("hang"):
            until(lambda: store.jobs.get(job).state is JobState.RUNNING and pids(store, job))
        assert store.jobs.get(job).state is JobState.QUEUED
    assert not any(alive(pid) for pid in pids(store, job))


def test_what_a_dead_server_left_running_is_ended_before_its_job_runs_again(
    store: Store, supervising: Supervising
) -> None:
    job = submit(store)
    assert store.attempts.claim(LEASE) is not None
    command = [sys.executable, "-S", "-c", "import time; time.sleep(600)"]
    left = subprocess.Popen(command, env=os.environ | mark(job), start_new_session=True)
    bystander = subprocess.Popen(command, env=os.environ | mark("0" * 32), start_new_session=True)
    try:
        with supervising("answer"):
            assert ended(store, job).attempt == 2
            assert not alive(left.pid) and alive(bystander.pid)
    finally:
        bystander.kill()
        left.wait()
        bystander.wait()


def test_what_a_job_process_started_ends_when_its_server_does() -> None:
    code = """if True:
        import subprocess, sys
        from service.jobs.child import _end_with_parent
        own = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        print(own.pid, flush=True)
        _end_with_parent(open(0, "rb", buffering=0))
    """
    command = [sys.executable, "-c", code]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    assert child.stdin is not None and child.stdout is not None
    grandchild = int(child.stdout.readline())
    assert alive(grandchild)
    child.stdin.close()  # as when the server is killed
    child.stdout.close()
    assert child.wait() == -signal.SIGKILL
    until(lambda: not alive(grandchild))


def environment(pid: int) -> bytes:
    """Of a process, as the system tells it: nothing for a moment after its start."""
    return Path(f"/proc/{pid}/environ").read_bytes()


def test_process_that_a_leftover_started_while_it_was_looked_for_is_ended_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    job = "1" * 32
    command = [sys.executable, "-S", "-c", "import time; time.sleep(600)"]
    found = [subprocess.Popen(command, env=os.environ | mark(job)) for _ in range(2)]
    until(lambda: all(job.encode() in environment(process.pid) for process in found))
    looks = iter([[found[0].pid], [found[1].pid], []])
    monkeypatch.setattr(leftovers, "_processes", lambda: next(looks))
    assert leftovers.end_leftovers([job]) == 2
    assert [process.wait() for process in found] == [-signal.SIGKILL] * 2


def test_job_of_a_dead_server_is_queued_again_then_failed(store: Store) -> None:
    job = submit(store)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        claimed = store.attempts.claim(LEASE)
        assert claimed is not None and (claimed.id, claimed.attempt) == (job, attempt)
        store.attempts.lose_all("the server died")
    found = store.jobs.get(job)
    assert found.state is JobState.FAILED and found.problem is not None and "3 attempts" in found.problem["got"]
    assert store.attempts.claim(LEASE) is None


def test_job_that_was_canceling_when_the_server_died_is_canceled(store: Store) -> None:
    job = submit(store)
    assert store.attempts.claim(LEASE) is not None
    store.attempts.cancel(job)
    store.attempts.lose_all("the server died")
    assert store.jobs.get(job).state is JobState.CANCELED


def test_job_that_gets_no_room_fails_instead_of_running_for_ever(
    store: Store, supervising: Supervising, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: DataDirectory) -> Any:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(DataDirectory, "scratch", full)
    job = submit(store)
    with supervising("answer"):
        assert ended(store, job).state is JobState.FAILED


def test_jobs_are_claimed_in_order(store: Store) -> None:
    jobs = [submit(store) for _ in range(3)]
    claimed = [store.attempts.claim(LEASE) for _ in jobs]
    assert [job.id for job in claimed if job is not None] == jobs
    assert [job.id for job in store.jobs.all()] == jobs[::-1]


def test_log_and_progress_stay_bounded_and_numbers_grow(store: Store) -> None:
    job = submit(store)
    assert store.attempts.claim(LEASE) is not None
    for number in range(230):
        store.attempts.log(job, 1, f"line {number} " + "x" * 1000)
        store.attempts.advance(job, 1, {"done": number})
    events = store.events.after(job, 0)
    assert len(events) == 2 + 200 + 1
    assert [event.number for event in events] == sorted({event.number for event in events})
    assert log_of(store, job).endswith("x") and "line 229" in log_of(store, job) and len(log_of(store, job)) < 110_000
    last = events[-1].number
    assert store.events.after(job, last) == []
    store.attempts.log(job, 1, "one more")
    assert [event.number for event in store.events.after(job, last)] == [last + 1]
