"""The gate: which hosts and pages may ask, and how many uploads at a time."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.datastructures import Headers

from liftcore.errors import SplatliftError
from service.auth import CALLER, Gate, Hosts, host_name, is_loopback
from service.errors import Busy, ForeignOrigin, Misdirected, TooMany
from service.scopes import OPEN, needed
from service.settings import ServiceSettings
from service.store.owners import Owner
from service.store.store import Store
from service.streams import EventStreams
from tests.crash.conftest import order

from .guarded import Guarded, bearer, finish, guarded, make_key
from .test_problems import assert_problem

HERE = Hosts("127.0.0.1", ["lift.example.org"])
EVERYWHERE = Hosts("0.0.0.0", [])


@pytest.fixture
def house(tmp_path: Path) -> Iterator[Guarded]:
    with guarded(tmp_path / "data", allowed_hosts="Lift.example.org, other.example.org") as made:
        yield made


def check(hosts: Hosts, method: str = "GET", **headers: str) -> None:
    hosts.check(method, Headers(headers))


def test_own_names_are_taken_and_no_other() -> None:
    for host in ("localhost", "LOCALHOST:8787", "127.0.0.1:1", "[::1]:8787", "[::1]", "lift.example.org:443",
                 "localhost.", "localhost:"):  # fmt: skip
        check(HERE, host=host)
    for host in ("evil.example", "evil.example:8787", "localhost.evil.example", "127.0.0.1.evil.example", "", ":80",
                 "[::1", "192.0.2.1", "localhost:port", "localhost@evil.example", "evil.example@localhost",
                 "[localhost]", "[]"):  # fmt: skip
        with pytest.raises(Misdirected):
            check(HERE, host=host)
    for hosts in ([], [(b"host", b"localhost"), (b"host", b"localhost")]):  # none, and two
        with pytest.raises(Misdirected):
            HERE.check("GET", Headers(raw=hosts))


def test_service_on_all_addresses_takes_digits_and_no_names() -> None:
    check(EVERYWHERE, host="192.0.2.1:8787")
    check(EVERYWHERE, host="[2001:db8::1]:8787")
    with pytest.raises(Misdirected):
        check(EVERYWHERE, host="evil.example")
    loopback = [is_loopback(host) for host in ("localhost", "127.8.8.8", "::1", "0.0.0.0", "::", "example.org")]
    assert loopback == [True, True, True, False, False, False]


@given(st.text(st.characters(codec="latin-1"), max_size=40))
def test_no_header_breaks_the_gate_and_only_names_pass(text: str) -> None:
    try:
        check(HERE, "POST", host=text, origin=text)
    except SplatliftError:
        return
    assert host_name(text) in ("localhost", "127.0.0.1", "::1", "lift.example.org")


@given(st.sampled_from(["GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "BREW"]), st.text(max_size=20))
def test_what_is_not_listed_as_open_wants_a_scope(method: str, rest: str) -> None:
    for path in ("/" + rest, *(f"{path}{rest}" for path in OPEN)):
        assert (needed(method, path) is None) == (method in ("GET", "HEAD") and path in OPEN)


def test_own_page_may_change_things_and_foreign_ones_only_look() -> None:
    for origin in ("http://localhost:8787", "https://lift.example.org", "http://LOCALHOST:8787"):
        check(HERE, "POST", host="localhost:8787", origin=origin)
    for origin in ("https://evil.example", "null", "", "http://localhost:3000", "http://localhost", "file://",
                   "localhost:8787", "http://["):  # fmt: skip
        check(HERE, "GET", host="localhost:8787", origin=origin)  # without CORS headers no page can read the answer
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            with pytest.raises(ForeignOrigin):
                check(HERE, method, host="localhost:8787", origin=origin)


def test_gate_answers_with_problems(house: Guarded) -> None:
    reply = house.ask("alice", "GET", "/jobs", headers={"Host": "evil.example"})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/misdirected", 421)
    assert house.ask(None, "GET", "/healthz", headers={"Host": "evil.example"}).status_code == 421
    assert house.ask("alice", "GET", "/jobs", headers={"Host": "LIFT.example.org:80"}).status_code == 200
    reply = house.ask("alice", "POST", f"/jobs/{house.queued}/cancel", headers={"Origin": "https://evil.example"})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/foreign-origin", 403)
    assert "access-control-allow-origin" not in reply.headers
    own = house.ask("alice", "POST", f"/jobs/{house.queued}/cancel", headers={"Origin": "http://127.0.0.1"})
    assert own.status_code == 200


def gate_of(store: Store, app: Any, **settings: int) -> Gate:
    chosen = ServiceSettings.model_validate({"data": store.files.root, **settings})
    return Gate(app, store.keys, chosen, lambda: False)


async def through(gate: Gate, secret: str, path: str = "/assets/splats") -> None:
    """A PUT with a key, of which nobody reads or answers anything."""
    headers = [(b"host", b"localhost"), (b"authorization", f"Bearer {secret}".encode())]
    nothing: Any = None
    await gate({"type": "http", "method": "PUT", "path": path, "headers": headers}, nothing, nothing)


def test_uploads_at_a_time_have_a_quota_a_key(store: Store) -> None:
    alice, bob = (make_key(store, "write", max_uploads=2)[1] for _ in range(2))

    async def run() -> None:
        release, inside = anyio.Event(), list[str]()

        async def slow(scope: Any, receive: Any, send: Any) -> None:
            inside.append(scope["state"][CALLER].owner.key)
            await release.wait()
            raise OSError("it broke off")

        async def broken(*asked: str) -> None:
            with pytest.raises(OSError, match="broke"):
                await through(gate, *asked)

        gate = gate_of(store, slow)
        async with anyio.create_task_group() as group:
            for asked in ((alice,), (alice,), (bob,), (alice, "/lift")):  # which is no upload
                group.start_soon(broken, *asked)
            with anyio.fail_after(60):
                while len(inside) < 4:
                    await anyio.sleep(0.01)
            with pytest.raises(TooMany):
                await through(gate, alice)
            release.set()
        await broken(alice)  # what broke off counts no more
        assert len(inside) == 5

    anyio.run(run)


def test_key_has_its_own_quota_and_else_that_of_every_key(store: Store) -> None:
    quotas: list[tuple[int | None, int | None, int]] = []

    async def seen(scope: Any, receive: Any, send: Any) -> None:
        caller = scope["state"][CALLER]
        quotas.append((caller.owner.max_bytes, caller.owner.max_queued, caller.max_uploads))

    gate = gate_of(store, seen, key_bytes=70, key_queued=80, key_uploads=90)
    for own in ({}, {"max_bytes": 1}, {"max_queued": 2}, {"max_uploads": 3}, {"max_bytes": 0, "max_queued": 0}):
        anyio.run(through, gate, make_key(store, "write", **own)[1])
    assert quotas == [(70, 80, 90), (1, 80, 90), (70, 2, 90), (70, 80, 3), (0, 0, 90)]


def test_streams_at_a_time_have_a_share_a_key() -> None:
    streams = EventStreams(4, 2)

    def follow(key: str | None) -> None:
        streams.answer(lambda number: [], lambda event: "", 0, key)

    for key in ("alice", "alice", "bob"):
        follow(key)
    with pytest.raises(TooMany):
        follow("alice")
    follow(None)  # while there are no keys there are no shares
    with pytest.raises(Busy):
        follow("bob")
    few = EventStreams(2, 8)  # a share is never all of them
    few.answer(lambda number: [], lambda event: "", 0, "alice")
    with pytest.raises(TooMany):
        few.answer(lambda number: [], lambda event: "", 0, "alice")


def test_database_that_is_held_at_the_gate_is_503_with_retry_after(house: Guarded, monkeypatch: Any) -> None:
    held = sqlite3.OperationalError("database is locked")
    held.sqlite_errorcode = sqlite3.SQLITE_BUSY
    monkeypatch.setattr(house.store.database, "read", mock.Mock(side_effect=held))
    reply = house.ask("alice", "GET", "/jobs")
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
    assert int(reply.headers["retry-after"]) > 0


def test_stored_bytes_have_a_quota(tmp_path: Path) -> None:
    with guarded(tmp_path / "data", key_bytes=10_000) as house:
        used = sum(asset["bytes"] for asset in house.ask("alice", "GET", "/assets").json()["assets"]) + len(b"a lift")
        ident, secret = make_key(house.store, "read write", max_bytes=used)
        with house.store.database.write() as connection:
            connection.execute("UPDATE asset_owners SET owner = ?", (ident,))
            connection.execute("UPDATE jobs SET owner = ?", (ident,))
        replies = [
            house.client.put("/assets/splats", headers=bearer(secret), content=b"x"),
            house.client.post("/lift", headers=bearer(secret), json=house.body()),
        ]
        for reply in replies:
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/over-quota", 403)
            assert str(used) in reply.json()["expected"]
        assert house.client.delete(f"/jobs/{house.done}?with_lift=true", headers=bearer(secret)).status_code == 204
        reply = house.client.post("/lift", headers=bearer(secret), json=house.body())
        assert reply.status_code == 403  # the trade-off counts, too
        gone = house.client.delete(f"/jobs/{house.compared}?with_tradeoff=true", headers=bearer(secret))
        assert gone.status_code == 204
        assert house.client.post("/lift", headers=bearer(secret), json=house.body()).status_code == 202


def test_jobs_in_line_have_a_quota_a_key(tmp_path: Path) -> None:
    with guarded(tmp_path / "data", key_queued=2) as house:
        assert house.ask("alice", "POST", "/lift", json=house.body()).status_code == 202
        reply = house.ask("alice", "POST", "/lift", json=house.body())
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/too-many", 429)
        assert int(reply.headers["retry-after"]) > 0
        order(house.store, Owner(house.ids["bob"], sees_all=False))
        assert house.ask("bob", "POST", "/lift", json=house.body()).status_code == 202
        for _ in "ba":  # keys take turns, and hers was the last
            finish(house.store, b"")
        assert house.ask("alice", "POST", "/lift", json=house.body()).status_code == 202
