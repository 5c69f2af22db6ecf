"""The store does what a dict does, whatever the order of calls, crashes and collections between them."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, precondition, rule

from liftcore.errors import NotFound
from service.errors import Conflict, InUse, KeyReused, ServiceUnavailable
from service.models import FINAL_STATES, AssetKind, JobKind, JobState
from service.store.assets import CheckedUpload
from service.store.jobs import MAX_ATTEMPTS, EventKind, JobOrder
from service.store.lifts import FinishedLift, FinishedTradeoff
from service.store.owners import SERVICE, Owner, stored_bytes
from service.store.store import Store, collect

from .conftest import METADATA

MAX_QUEUED = 3
FOLDERS = ("blobs", "lifts", "work", "tmp")
OWNERS = {
    "": SERVICE,
    "a": Owner("a", sees_all=False),
    "b": Owner("b", sees_all=False),
    "admin": Owner("admin", sees_all=True),
}


@dataclass
class Model:
    """A job as the model knows it."""

    order: JobOrder
    owner: str
    state: str = "queued"
    attempt: int = 0
    released: int = 0
    result: bytes | None = None
    story: list[str] = field(default_factory=lambda: ["queued"])

    def move(self, state: str) -> None:
        self.state = state
        self.story.append(state)


class StoreMachine(RuleBasedStateMachine):
    """Rules are what routes, the supervisor, crashes and the collector do; the model is three dicts and a line.

    Who asks is one of OWNERS: the service itself, two keys that see their own, and an admin.
    """

    contents = Bundle("contents")
    attempts = Bundle("attempts")

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.store = Store.open(Path(self.folder.name))
        self.assets: dict[str, bytes] = {}
        self.owners_of_assets: dict[str, set[str]] = {}  # asset -> who has it
        self.jobs: dict[str, Model] = {}
        self.turns: Counter[str] = Counter()  # of owners, since the start

    def teardown(self) -> None:
        self.store.close()
        self.folder.cleanup()

    @initialize(target=contents)
    def begin(self) -> Any:
        return multiple(*(self.put(kind, b"first", "a") for kind in AssetKind))

    def sees(self, owner_name: str, asset: str) -> bool:
        return asset in self.assets and (OWNERS[owner_name].sees_all or owner_name in self.owners_of_assets[asset])

    def put(self, kind: AssetKind, content: bytes, owner_name: str) -> str:
        content = kind.encode() + content
        digest = hashlib.sha256(content).hexdigest()
        with self.store.files.draft(".bin") as draft:
            draft.write_bytes(content)
            upload = CheckedUpload(draft, kind, digest, ".bin", {}, [])
            asset, new = self.store.assets.add(OWNERS[owner_name], upload)
        assert new == (owner_name not in self.owners_of_assets.get(asset.id, set()))
        self.assets[asset.id] = content
        self.owners_of_assets.setdefault(asset.id, set()).add(owner_name)
        return asset.id

    @rule(
        target=contents,
        kind=st.sampled_from(AssetKind),
        content=st.just(b"first") | st.binary(max_size=2),
        owner_name=st.sampled_from([*OWNERS]),
    )
    def upload(self, kind: AssetKind, content: bytes, owner_name: str) -> str:
        return self.put(kind, content, owner_name)

    @precondition(lambda self: len(self.assets) > 1)
    @rule(asset=contents, owner_name=st.sampled_from([*OWNERS]))
    def delete_asset(self, asset: str, owner_name: str) -> None:
        users = [
            job
            for job, model in self.jobs.items()
            if asset in (asset_id for asset_id, _ in model.order.assets())
            and (OWNERS[owner_name].sees_all or model.owner == owner_name)
        ]
        assets, owner = self.store.assets, OWNERS[owner_name]
        if not self.sees(owner_name, asset):
            with pytest.raises(NotFound):
                assets.delete(owner, asset)
        elif users:
            with pytest.raises(InUse) as error:
                assets.delete(owner, asset)
            assert set(error.value.hint.partition(": ")[2].split(", ")) <= set(users)
        else:
            assets.delete(owner, asset)
            self.owners_of_assets[asset] -= set(OWNERS) if OWNERS[owner_name].sees_all else {owner_name}
            if not self.owners_of_assets[asset]:
                del self.assets[asset], self.owners_of_assets[asset]

    @rule(
        data=st.data(),
        key=st.none() | st.sampled_from(["a", "b"]),
        print_=st.sampled_from(["x", "x", "y"]),
        mistaken=st.sampled_from([False] * 9 + [True]),
        owner_name=st.sampled_from(["a", "a", *OWNERS]),
        kind=st.sampled_from(JobKind),
        labelled=st.booleans(),
    )
    def submit(
        self, data: Any, key: str | None, print_: str, mistaken: bool, owner_name: str, kind: JobKind, labelled: bool
    ) -> None:
        assets = []
        asset_kinds = [*AssetKind][:5] if labelled and kind is JobKind.TRADEOFF else [*AssetKind][:3]
        for asset_kind in asset_kinds:
            right = [asset for asset in sorted(self.assets) if self.assets[asset].startswith(asset_kind.encode())]
            assets.append(data.draw(st.sampled_from(sorted(self.assets) if mistaken or not right else right)))
        parameters = {"labels": {"masks": assets[3], "table": assets[4]}} if len(assets) > 3 else {}
        order = JobOrder(assets[0], assets[1], (assets[2],), {}, key, print_, kind=kind, parameters=parameters)
        earlier = [
            job
            for job, model in self.jobs.items()
            if key is not None and (model.order.key, model.owner) == (key, owner_name)
        ]
        jobs, owner = self.store.jobs, OWNERS[owner_name]
        kinds = [
            self.store.assets.get(SERVICE, asset).kind if self.sees(owner_name, asset) else None for asset in assets
        ]
        if earlier and self.jobs[earlier[0]].order.fingerprint != print_:
            expected: type[Exception] | None = KeyReused
        elif not earlier and sum(model.state == "queued" for model in self.jobs.values()) >= MAX_QUEUED:
            expected = ServiceUnavailable
        elif not earlier and kinds != asset_kinds:
            expected = NotFound
        else:
            expected = None
        if expected is not None:
            with pytest.raises(expected):
                jobs.submit(owner, order, max_queued=MAX_QUEUED)
            return
        job, new = jobs.submit(owner, order, max_queued=MAX_QUEUED)
        assert new == (not earlier) and (new or job == earlier[0])
        if new:
            self.jobs[job] = Model(order, owner_name)
            for asset in assets:
                self.owners_of_assets[asset].add(owner_name)

    @rule(target=attempts)
    def claim(self) -> tuple[str, int]:
        claimed_job = self.store.jobs.claim()
        line = [job for job, model in self.jobs.items() if model.state == "queued"]
        if claimed_job is None:
            assert not line
            return "0" * 32, 1
        model = self.jobs[claimed_job.id]
        # Its owner's oldest.
        assert claimed_job.id == next(job for job in line if self.jobs[job].owner == model.owner)
        running = Counter(job.owner for job in self.jobs.values() if job.state in ("running", "canceling"))
        waiting = [(running[self.jobs[job].owner], self.turns[self.jobs[job].owner]) for job in line]
        assert (running[model.owner], self.turns[model.owner]) == min(waiting)
        self.turns[model.owner] = max(self.turns.values(), default=0) + 1
        model.attempt += 1
        model.move("running")
        return claimed_job.id, claimed_job.attempt

    def owner(self, attempt: tuple[str, int]) -> Model | None:
        """The job when this attempt is its present one, however old the claim is."""
        model = self.jobs.get(attempt[0])
        owns = model is not None and model.attempt == attempt[1] and model.state in ("running", "canceling")
        return model if owns else None

    @rule(attempt=attempts, content=st.binary(max_size=3))
    def finish(self, attempt: tuple[str, int], content: bytes) -> None:
        model = self.owner(attempt)
        if attempt[0] in self.jobs and self.jobs[attempt[0]].order.kind is JobKind.TRADEOFF:
            is_finished = self.store.tradeoffs.finish(*attempt, FinishedTradeoff({}, "", content))
        else:
            with self.store.files.draft(".safetensors") as draft:
                draft.write_bytes(content)
                is_finished = self.store.lifts.finish(*attempt, FinishedLift(draft, "0" * 64, 1, 1, METADATA))
        assert is_finished == (model is not None and model.state == "running")
        if is_finished and model is not None:
            model.result = content
            model.move("succeeded")

    @rule(attempt=attempts)
    def fail(self, attempt: tuple[str, int]) -> None:
        model = self.owner(attempt)
        fault = {"kind": "crashed", "argument": "", "expected": "", "got": "", "hint": ""}
        self.store.jobs.fail(*attempt, fault)
        if model is not None:
            model.move("canceled" if model.state == "canceling" else "failed")

    @rule(attempt=attempts)
    def release(self, attempt: tuple[str, int]) -> None:
        model = self.owner(attempt)
        self.store.jobs.release(*attempt, "the server stops")
        if model is not None:
            model.released += 1
            model.move("canceled" if model.state == "canceling" else "queued")

    @rule(attempt=attempts)
    def lose(self, attempt: tuple[str, int]) -> None:
        model = self.owner(attempt)
        self.store.jobs.lose(*attempt, "why")
        if model is not None:
            self.fail_or_requeue(model)

    def fail_or_requeue(self, model: Model) -> None:
        if model.state == "canceling":
            model.move("canceled")
        else:
            model.move("failed" if model.attempt - model.released >= MAX_ATTEMPTS else "queued")

    @rule(attempt=attempts)
    def advance(self, attempt: tuple[str, int]) -> None:
        self.store.jobs.advance(*attempt, {"completed": 1})

    def draw_job(self, data: Any) -> str:
        """A job by its place in line: ids are random, so a choice among them would differ when a story is retold."""
        return [*self.jobs][data.draw(st.integers(0, len(self.jobs) - 1))]

    @precondition(lambda self: self.jobs)
    @rule(data=st.data(), owner_name=st.sampled_from([*OWNERS]))
    def cancel(self, data: Any, owner_name: str) -> None:
        job = self.draw_job(data)
        model = self.jobs[job]
        jobs, owner = self.store.jobs, OWNERS[owner_name]
        if not OWNERS[owner_name].sees_all and model.owner != owner_name:
            with pytest.raises(NotFound):
                jobs.cancel(owner, job)
            return
        if model.state in ("succeeded", "failed"):
            with pytest.raises(Conflict):
                jobs.cancel(owner, job)
            return
        assert jobs.cancel(owner, job) == (model.state in ("queued", "running"))
        if model.state in ("queued", "running"):
            model.move("canceled" if model.state == "queued" else "canceling")

    @precondition(lambda self: self.jobs)
    @rule(data=st.data(), given_up=st.sets(st.sampled_from(JobKind)), owner_name=st.sampled_from([*OWNERS]))
    def delete_job(self, data: Any, given_up: set[JobKind], owner_name: str) -> None:
        job = self.draw_job(data)
        model = self.jobs[job]
        jobs, owner = self.store.jobs, OWNERS[owner_name]
        if not OWNERS[owner_name].sees_all and model.owner != owner_name:
            with pytest.raises(NotFound):
                jobs.delete(owner, job, given_up=given_up)
        elif model.state in FINAL_STATES and (model.result is None or model.order.kind in given_up):
            jobs.delete(owner, job, given_up=given_up)
            del self.jobs[job]
        else:
            with pytest.raises(Conflict):
                jobs.delete(owner, job, given_up=given_up)

    @rule()
    def collect(self) -> None:
        assert collect(self.store, time.time() + 1) == []  # without a crash there is no garbage

    @rule()
    def crash_and_start_again(self) -> None:
        """Close without a word to the attempts, as a killed server does; litter lies about."""
        root = self.store.files.root
        self.store.close()
        litter = (root / "blobs" / "ab" / "abcd.ply", root / "lifts" / "x.safetensors", root / "tmp" / "y")
        for path in litter:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"half")
        self.store = Store.open(root)
        self.store.jobs.release_all("the server died")
        self.turns.clear()
        for model in self.jobs.values():
            if model.state in ("running", "canceling"):
                model.released += 1
                model.move("canceled" if model.state == "canceling" else "queued")
        assert set(collect(self.store, time.time() + 1)) == set(litter[:2])

    @invariant()
    def agrees(self) -> None:
        assert {asset.id: asset.path.read_bytes() for asset in self.store.assets.all(SERVICE)} == self.assets
        states = {job.id: (job.state, job.attempt) for job in self.store.jobs.all(SERVICE)}
        assert states == {job: (JobState(model.state), model.attempt) for job, model in self.jobs.items()}
        lifts = {lift.id: lift.path.read_bytes() for lift in self.store.lifts.all(SERVICE)}
        assert lifts == self.results(JobKind.LIFT)
        for job, chart in self.results(JobKind.TRADEOFF).items():
            assert self.store.tradeoffs.get(SERVICE, job).chart == chart
        for job, model in self.jobs.items():
            events = self.store.jobs.events(SERVICE, job, 0)
            assert [event.data["state"] for event in events if event.kind is EventKind.STATE] == model.story
            assert model.story.count("succeeded") <= 1
        for owner_name in OWNERS:
            self.sees_its_own(owner_name)
        files = [path for folder in FOLDERS for path in (self.store.files.root / folder).rglob("*") if path.is_file()]
        assert len(files) == len(self.assets) + len(lifts)

    def results(self, kind: JobKind) -> dict[str, bytes]:
        expected = {job: model.result for job, model in self.jobs.items() if model.order.kind is kind}
        return {job: content for job, content in expected.items() if content is not None}

    def sees_its_own(self, owner_name: str) -> None:
        store_view, owner = self.store, OWNERS[owner_name]
        jobs = {job for job, model in self.jobs.items() if owner.sees_all or model.owner == owner_name}
        assert {asset.id for asset in store_view.assets.all(owner)} == {
            asset for asset in self.assets if self.sees(owner_name, asset)
        }
        assert {job.id for job in store_view.jobs.all(owner)} == jobs
        lifts, tradeoffs = (self.results(kind) for kind in JobKind)
        assert {lift.id for lift in store_view.lifts.all(owner)} == jobs & lifts.keys()
        for job in self.jobs:
            assert (store_view.jobs.state(owner, job) is not None) == (job in jobs)
            assert (store_view.lifts.find(owner, job) is not None) == (job in jobs & lifts.keys())
            if job not in jobs & tradeoffs.keys():
                with pytest.raises(NotFound):
                    store_view.tradeoffs.get(owner, job)
        stored = sum(
            len(content) for asset, content in self.assets.items() if owner_name in self.owners_of_assets[asset]
        )
        stored += sum(len(content) for job, content in lifts.items() if self.jobs[job].owner == owner_name)
        stored += sum(
            len(b"{}" + content) for job, content in tradeoffs.items() if self.jobs[job].owner == owner_name
        )
        with self.store.database.read() as connection:
            assert stored_bytes(connection, OWNERS[owner_name]) == stored


TestStoreMachine = StoreMachine.TestCase
TestStoreMachine.settings = settings(
    max_examples=15,
    stateful_step_count=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
