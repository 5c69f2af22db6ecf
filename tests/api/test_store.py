"""The store of the service: a model of its jobs and assets, orders once, attempts, full disks and kept files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from liftcore.errors import NotFound
from service.commands.store import back_up, clean, verify
from service.errors import Busy, Conflict, KeyReused, Misconfigured, NoSpace
from service.models import FINAL_STATES, Job
from service.store import DATABASE, MAX_ATTEMPTS, SERVICE, Owner, Store, open_keys, revoke_key

ANNA, BERT = Owner("anna"), Owner("bert")
KINDS = ("splats", "cameras", "features")
PROBLEM = {"type": "/problems/x", "title": "x", "status": 422, "detail": "x"}


def open_store(path: Path, **options: Any) -> Store:
    """Return the store of a directory in which both owners have their keys."""
    store = Store(path, **options)
    with store.write() as connection:
        for name in (ANNA.owner, BERT.owner):
            row = (name, name, name, "read write", "[]", None, 0.0, None, None)
            connection.execute("INSERT OR IGNORE INTO keys VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
    return store


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(open_store(tmp_path / "data")) as store:
        yield store


def add_asset(store: Store, owner: Owner, kind: str, content: bytes) -> str:
    """Store an upload that was checked; return its id."""
    with store.scratch() as scratch:
        draft = scratch / "upload"
        draft.write_bytes(content)
        description = {"suffix": f".{kind}", "counts": {"splats": 1}, "warnings": []}
        digest = hashlib.sha256(content).hexdigest()
        return store.add_asset(owner, kind, draft, digest, description).id


def order_of(store: Store, owner: Owner) -> dict[str, Any]:
    """Return the order of a lift of assets that the owner has."""
    splats, cameras, features = (add_asset(store, owner, kind, kind.encode()) for kind in KINDS)
    inputs = {"splats": splats, "cameras": cameras, "features": [features]}
    return {"kind": "lift", **inputs, "settings": {}, "parameters": {}}


def finish(store: Store, job: Job) -> None:
    """End an attempt at a job with a lift."""
    metadata = {
        "version": "0", "settings": {}, "encoder": "", "text_space": "none", "views": [], "view_count": 0,
        "diagnostics": {}, "timings": {}, "features": [],
    }  # fmt: skip
    with store.scratch() as scratch:
        draft = scratch / "lift"
        draft.write_bytes(job.id.encode())
        digest = hashlib.sha256(job.id.encode()).hexdigest()
        store.finish(job, {"sha256": digest, "count": 1, "channels": 1, "metadata": metadata}, draft)


def states_of(store: Store, job: str) -> list[str]:
    events = store.events(SERVICE, job, 0)
    return [json.loads(event["data"])["state"] for event in events if event["kind"] == "state"]


# Orders and attempts


def test_same_key_and_order_are_one_job_of_their_owner(store: Store) -> None:
    order = order_of(store, ANNA)
    order_of(store, BERT)
    first, is_new = store.submit(ANNA, order, "key")
    assert (is_new, store.submit(ANNA, order, "key")) == (True, (first, False))
    with pytest.raises(KeyReused):
        store.submit(ANNA, order | {"settings": {"preset": "default"}}, "key")
    other, is_new = store.submit(BERT, order, "key")
    assert is_new and other.id != first.id
    with pytest.raises(NotFound):
        store.job(BERT, first.id)


def test_twelve_threads_with_one_key_make_one_job(store: Store) -> None:
    order, ids = order_of(store, ANNA), set[str]()
    threads = [threading.Thread(target=lambda: ids.add(store.submit(ANNA, order, "key")[0].id)) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ids) == 1 and store.counts_by_state() == {"queued": 1}


def test_order_of_anothers_asset_is_refused(store: Store) -> None:
    order = order_of(store, ANNA)
    with pytest.raises(NotFound, match="splats"):
        store.submit(BERT, order)
    assert store.counts_by_state() == {}


def test_full_line_refuses_new_jobs_and_repeats_known_ones(store: Store) -> None:
    order = order_of(store, ANNA)
    job, _ = store.submit(ANNA, order, "key", max_queued=1)
    with pytest.raises(Busy):
        store.submit(ANNA, order, max_queued=1)
    assert store.submit(ANNA, order, "key", max_queued=1) == (job, False)


def test_attempts_without_an_answer_end_a_job_after_the_third(store: Store) -> None:
    job, _ = store.submit(ANNA, order_of(store, ANNA))
    for attempt in range(1, MAX_ATTEMPTS + 1):
        active = store.claim()
        assert active is not None and active.attempt == attempt
        store.end(active, PROBLEM, retries=True)
    record = store.job(ANNA, job.id)
    assert (record.state, record.attempt, store.claim()) == ("failed", MAX_ATTEMPTS, None)
    assert states_of(store, job.id) == ["queued", *["running", "queued"] * (MAX_ATTEMPTS - 1), "running", "failed"]


def test_attempts_that_the_server_ended_do_not_count(store: Store) -> None:
    job, _ = store.submit(ANNA, order_of(store, ANNA))
    for _ in range(MAX_ATTEMPTS + 2):
        active = store.claim()
        assert active is not None and active.attempt == 1
        store.end(active)
    assert store.job(ANNA, job.id).state == "queued"


def test_job_that_has_its_result_is_not_put_back_in_line(store: Store) -> None:
    store.submit(ANNA, order_of(store, ANNA))
    job = store.claim()
    assert job is not None
    finish(store, job)
    store.end(job)
    assert states_of(store, job.id) == ["queued", "running", "succeeded"]


def test_jobs_of_a_server_that_died_go_back_in_line(tmp_path: Path) -> None:
    with closing(open_store(tmp_path)) as store:
        running, _ = store.submit(ANNA, order_of(store, ANNA))
        assert store.claim() is not None
        store.submit(ANNA, order_of(store, ANNA))
    with closing(open_store(tmp_path)) as store:
        assert [store.job(ANNA, running.id).state, store.job(ANNA, running.id).attempt] == ["queued", 0]
        active = store.claim()
        assert active is not None and active.id == running.id
        assert store.cancel(ANNA, running.id).state == "canceling"
    with closing(open_store(tmp_path)) as store:
        assert store.job(ANNA, running.id).state == "canceled"


def test_job_that_is_being_canceled_gets_no_result(store: Store) -> None:
    job, _ = store.submit(ANNA, order_of(store, ANNA))
    active = store.claim()
    assert active is not None and store.cancel(ANNA, job.id).state == "canceling"
    finish(store, active)
    assert store.job(ANNA, job.id).state == "canceled"
    assert list((store.root / "lifts").iterdir()) == []
    with pytest.raises(NotFound):
        store.lift(ANNA, job.id)


def test_result_goes_only_with_a_job_that_is_deleted_with_it(store: Store) -> None:
    store.submit(ANNA, order_of(store, ANNA))
    job = store.claim()
    assert job is not None
    finish(store, job)
    with pytest.raises(Conflict, match="with_lift"):
        store.delete_job(ANNA, job.id, with_result=False)
    assert store.lift(ANNA, job.id).file.is_file()
    store.delete_job(ANNA, job.id, with_result=True)
    assert list((store.root / "lifts").iterdir()) == []
    for lift, message in ((None, "at least one lift"), (job.id, "the id of a lift")):
        with pytest.raises(NotFound, match=message):
            store.lift(ANNA, lift)


def test_revoked_key_follows_no_job_and_its_queued_jobs_are_canceled(store: Store) -> None:
    running, _ = store.submit(ANNA, order_of(store, ANNA))
    assert store.claim() is not None
    queued, _ = store.submit(ANNA, order_of(store, ANNA))
    other, _ = store.submit(BERT, order_of(store, BERT))
    assert store.events(ANNA, running.id, 0)
    with open_keys(store.root) as connection:
        revoke_key(connection, ANNA.owner)
    with pytest.raises(NotFound):
        store.events(ANNA, running.id, 0)
    claimed = store.claim()
    assert claimed is not None and claimed.id == other.id
    assert [store.job(SERVICE, job.id).state for job in (running, queued)] == ["running", "canceled"]


@pytest.mark.parametrize("table", ["assets", "jobs"])
def test_pages_have_each_record_once_where_clocks_stand_still(
    store: Store, table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.time", lambda: 1.0)
    order = order_of(store, ANNA)
    count = len(KINDS) if table == "assets" else 5
    for _ in range(5):
        store.submit(ANNA, order)
    ids, cursor = list[str](), None
    while not ids or cursor:
        rows, cursor = store.page(table, ANNA, 2, cursor)
        ids += [row["id"] for row in rows]
    assert len(ids) == len(set(ids)) == count


# Disks


def test_files_are_on_the_disk_before_their_rows(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed, flush = set[int](), os.fsync

    def note(handle: int) -> None:
        assert store.rows("SELECT count(*) AS count FROM assets UNION ALL SELECT count(*) FROM lifts") == before
        flushed.add(os.fstat(handle).st_ino)
        flush(handle)

    job, _ = store.submit(ANNA, order_of(store, ANNA))
    active = store.claim()
    assert active is not None
    before = store.rows("SELECT count(*) AS count FROM assets UNION ALL SELECT count(*) FROM lifts")
    monkeypatch.setattr(os, "fsync", note)
    finish(store, active)
    lift = store.lift(ANNA, job.id).file
    assert flushed == {path.stat().st_ino for path in (lift, lift.parent)}
    before = store.rows("SELECT count(*) AS count FROM assets UNION ALL SELECT count(*) FROM lifts")
    asset = store.asset(ANNA, add_asset(store, ANNA, "splats", b"x")).file
    assert {path.stat().st_ino for path in (asset, asset.parent)} < flushed
    with store.write() as connection:
        assert connection.execute("PRAGMA synchronous").fetchone()[0] == 2  # each commit waits for the disk


def test_another_file_in_the_place_of_the_database_is_noticed(store: Store) -> None:
    store.require_usable()
    copy = store.root / "copy"
    shutil.copyfile(store.root / DATABASE, copy)
    copy.replace(store.root / DATABASE)
    with pytest.raises(sqlite3.OperationalError, match="another file"):
        store.require_usable()


def test_disk_below_its_floor_takes_no_work_and_gives_room(tmp_path: Path) -> None:
    with closing(open_store(tmp_path)) as store:
        asset = add_asset(store, ANNA, "splats", b"x")
    with closing(open_store(tmp_path, floor_bytes=1 << 62)) as store:
        with pytest.raises(NoSpace):
            store.require_room()
        store.delete_asset(ANNA, asset)
        assert list((tmp_path / "blobs").iterdir()) == []


def test_lift_whose_row_cannot_be_committed_stays_a_draft(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    store.submit(ANNA, order_of(store, ANNA))
    job = store.claim()
    assert job is not None
    monkeypatch.setattr(store, "_move", lambda *_, **__: (_ for _ in ()).throw(sqlite3.OperationalError("full")))
    with pytest.raises(sqlite3.OperationalError):
        finish(store, job)
    monkeypatch.undo()
    assert list((store.root / "lifts").iterdir()) == []
    finish(store, job)
    assert store.lift(ANNA, job.id).id == job.id


def test_reads_answer_while_another_process_holds_the_database(store: Store) -> None:
    asset = add_asset(store, ANNA, "splats", b"x")
    with closing(sqlite3.connect(store.root / DATABASE, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        assert store.asset(ANNA, asset).id == asset
        other.execute("ROLLBACK")


# Files


def test_files_without_a_row_stay_until_they_are_cleaned(tmp_path: Path) -> None:
    with closing(open_store(tmp_path)) as store:
        add_asset(store, ANNA, "splats", b"x")
        for name in ("blobs/stray.ply", "lifts/stray.safetensors"):
            (tmp_path / name).write_bytes(b"stray")
    with closing(open_store(tmp_path)) as store:
        assert len(store.unnamed_files()) == 2
        with pytest.raises(Misconfigured, match="no other server"):
            clean(tmp_path)
    assert sorted(clean(tmp_path)) == ["blobs/stray.ply", "lifts/stray.safetensors"]
    assert len(list((tmp_path / "blobs").iterdir())) == 1 and clean(tmp_path) == []


def test_directory_without_its_database_or_with_anothers_is_refused(tmp_path: Path) -> None:
    with closing(open_store(tmp_path)) as store:
        add_asset(store, ANNA, "splats", b"x")
    with closing(sqlite3.connect(tmp_path / DATABASE)) as connection:
        connection.execute("PRAGMA user_version = 7")
    with pytest.raises(Misconfigured, match="schema"):
        Store(tmp_path)
    for path in tmp_path.glob(f"{DATABASE}*"):
        path.write_bytes(b"no database at all, but many letters" * 100)
    with pytest.raises(Misconfigured, match="database"):
        Store(tmp_path)
    for path in tmp_path.glob(f"{DATABASE}*"):
        path.unlink()
    with pytest.raises(Misconfigured, match=DATABASE):
        Store(tmp_path)
    (tmp_path / DATABASE).touch()  # empty
    with pytest.raises(Misconfigured, match=DATABASE):
        Store(tmp_path)
    assert len(list((tmp_path / "blobs").iterdir())) == 1


def test_bytes_that_are_here_as_another_kind_are_refused(store: Store) -> None:
    asset = add_asset(store, ANNA, "splats", b"x")
    with pytest.raises(Conflict, match="cameras, here as splats"):
        add_asset(store, ANNA, "cameras", b"x")
    assert store.asset(ANNA, asset, "splats").file.read_bytes() == b"x" and store.unnamed_files() == []


def test_bytes_of_two_owners_go_with_the_last(store: Store) -> None:
    asset = add_asset(store, ANNA, "splats", b"x")
    assert add_asset(store, BERT, "splats", b"x") == asset
    store.delete_asset(ANNA, asset)
    assert store.asset(BERT, asset).file.read_bytes() == b"x"
    store.delete_asset(BERT, asset)
    assert list((store.root / "blobs").iterdir()) == []


def test_backup_is_a_directory_that_starts_and_damage_is_found(tmp_path: Path) -> None:
    with closing(open_store(tmp_path / "data")) as store:
        store.submit(ANNA, order_of(store, ANNA))
        job = store.claim()
        assert job is not None
        finish(store, job)
        assert back_up(tmp_path / "data", tmp_path / "backup") == 4
    with pytest.raises(Misconfigured, match="not there yet"):
        back_up(tmp_path / "data", tmp_path / "backup")
    assert verify(tmp_path / "backup") == []
    with closing(open_store(tmp_path / "backup")) as copy:
        assert copy.lift(ANNA, job.id).file.read_bytes() == job.id.encode()
        file = copy.lift(ANNA, job.id).file
    file.unlink()
    file.write_bytes(b"y" * 32)
    assert len(verify(tmp_path / "backup")) == 1 and verify(tmp_path / "data") == []
    (tmp_path / "data" / "lifts" / file.name).unlink()
    with pytest.raises(Misconfigured, match="1 lost"):
        back_up(tmp_path / "data", tmp_path / "other")
    assert not (tmp_path / "other").exists()


# A model of jobs and assets, which the store must agree with after any sequence of calls


class StoreMachine(RuleBasedStateMachine):
    """Assets and jobs of two owners, beside dictionaries."""

    owners = st.sampled_from((ANNA, BERT))

    @initialize()
    def begin(self) -> None:
        import tempfile

        self.folder = tempfile.TemporaryDirectory()
        self.store = open_store(Path(self.folder.name))
        self.rows = dict[tuple[str, str], str]()  # asset, owner -> kind
        self.states = dict[str, tuple[str, Owner, int]]()  # job -> state, owner, attempt
        self.orders = dict[str, dict[str, Any]]()

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            self.folder.cleanup()

    @rule(owner=owners, number=st.integers(0, 2))
    def order(self, owner: Owner, number: int) -> None:
        ids = [add_asset(self.store, owner, kind, f"{kind}{number}".encode()) for kind in KINDS]
        self.rows |= {(asset, owner.owner): kind for asset, kind in zip(ids, KINDS, strict=True)}
        inputs = {"splats": ids[0], "cameras": ids[1], "features": ids[2:]}
        job, _ = self.store.submit(owner, {"kind": "lift", **inputs, "settings": {}, "parameters": {}})
        self.states[job.id], self.orders[job.id] = ("queued", owner, 0), inputs

    @rule()
    def restart(self) -> None:
        self.store.close()
        self.store = open_store(Path(self.folder.name))
        for job, (state, owner, attempt) in self.states.items():
            if state in ("running", "canceling"):
                self.states[job] = ("queued" if state == "running" else "canceled", owner, attempt - 1)

    @rule(outcome=st.sampled_from(("finish", "fail", "lose", "release")), data=st.data())
    def attempt(self, outcome: str, data: st.DataObject) -> None:
        job = self.store.claim()
        waiting = [name for name, (state, _, _) in self.states.items() if state == "queued"]
        assert (job is None) == (not waiting)
        if job is None:
            return
        _, owner, attempt = self.states[job.id]
        self.states[job.id] = ("running", owner, attempt + 1)
        if is_canceled := data.draw(st.booleans()):
            assert self.store.cancel(owner, job.id).state == "canceling"
        if outcome == "finish":
            finish(self.store, job)
        else:
            self.store.end(job, None if outcome == "release" else PROBLEM, retries=outcome == "lose")
        later = attempt + 1
        state = {"finish": "succeeded", "fail": "failed", "release": "queued"}.get(outcome)
        if outcome == "lose":
            state = "queued" if later < MAX_ATTEMPTS else "failed"
        if outcome == "release" and not is_canceled:
            later -= 1
        self.states[job.id] = ("canceled" if is_canceled else str(state), owner, later)

    @rule(data=st.data(), caller=owners)
    def delete_or_cancel(self, data: st.DataObject, caller: Owner) -> None:
        if not self.states:
            return
        job = data.draw(st.sampled_from(list(self.states)))
        state, owner, attempt = self.states[job]
        if caller != owner:
            with pytest.raises(NotFound):
                self.store.cancel(caller, job)
        elif state in FINAL_STATES:
            self.store.delete_job(caller, job, with_result=True)
            del self.states[job], self.orders[job]
        else:
            assert self.store.cancel(caller, job).state == "canceled"
            self.states[job] = ("canceled", owner, attempt)

    @rule(data=st.data())
    def delete_asset(self, data: st.DataObject) -> None:
        if not self.rows:
            return
        asset, name = data.draw(st.sampled_from(sorted(self.rows)))
        owner = Owner(name)
        uses = [
            job for job, order in self.orders.items()
            if self.states[job][1] == owner and asset in (order["splats"], order["cameras"], *order["features"])
        ]  # fmt: skip
        if uses:
            with pytest.raises(Conflict):
                self.store.delete_asset(owner, asset)
        else:
            self.store.delete_asset(owner, asset)
            del self.rows[asset, name]

    @invariant()
    def agrees(self) -> None:
        if not hasattr(self, "store"):
            return
        for job, (state, owner, attempt) in self.states.items():
            record = self.store.job(owner, job)
            assert (record.state, record.attempt) == (state, attempt)
            assert states_of(self.store, job)[-1] == state
        for owner in (ANNA, BERT):
            rows, _ = self.store.page("assets", owner, 1000, None)
            assert {row["id"] for row in rows} == {asset for asset, name in self.rows if name == owner.owner}
            rows, _ = self.store.page("jobs", owner, 1000, None)
            own = {job for job, (_, name, _) in self.states.items() if name == owner}
            assert {row["id"] for row in rows} == own
        lifts = {job for job, (state, _, _) in self.states.items() if state == "succeeded"}
        assert {path.stem for path in (self.store.root / "lifts").iterdir()} == lifts
        files = {path.name.partition(".")[0] for path in (self.store.root / "blobs").iterdir()}
        assert files == {asset.removeprefix("sha256:") for asset, _ in self.rows}
        assert self.store.unnamed_files() == [] and list((self.store.root / "tmp").iterdir()) == []


StoreMachine.TestCase.settings = settings(
    max_examples=25,
    stateful_step_count=20,
    deadline=None,
    suppress_health_check=(HealthCheck.too_slow, HealthCheck.filter_too_much),
)
TestStore = StoreMachine.TestCase
