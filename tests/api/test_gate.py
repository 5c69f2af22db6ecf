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
from service.auth import CALLER, Caller, Gate, Hosts, host_name, is_loopback
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


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "LOCALHOST:8787",
        "127.0.0.1:1",
        "[::1]:8787",
        "[::1]",
        "lift.example.org:443",
        "localhost.",
        "localhost:",
    ],
)
def test_own_names_are_taken(host: str) -> None:
    check(HERE, host=host)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:8787", "localhost.evil.example", "127.0.0.1.evil.example", "", ":80", "[::1",
        "192.0.2.1", "localhost:port", "localhost@evil.example", "evil.example@localhost", "[localhost]", "[]",
    ],
)  # fmt: skip
def test_other_names_are_misdirected(host: str) -> None:
    with pytest.raises(Misdirected):
        check(HERE, host=host)


def test_without_a_host_or_with_two_nothing_is_said() -> None:
    with pytest.raises(Misdirected):
        check(HERE)
    with pytest.raises(Misdirected):
        HERE.check("GET", Headers(raw=[(b"host", b"localhost"), (b"host", b"localhost")]))


def test_service_on_all_addresses_takes_digits_and_no_names() -> None:
    check(EVERYWHERE, host="192.0.2.1:8787")
    check(EVERYWHERE, host="[2001:db8::1]:8787")
    with pytest.raises(Misdirected):
        check(EVERYWHERE, host="evil.example")


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


@pytest.mark.parametrize("origin", ["http://localhost:8787", "https://lift.example.org", "http://LOCALHOST:8787"])
def test_own_page_may_change_things(origin: str) -> None:
    check(HERE, "POST", host="localhost:8787", origin=origin)


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "", "http://localhost:3000", "http://localhost", "file://", "localhost:8787", "http://["],
)  # fmt: skip
def test_foreign_pages_may_only_look(origin: str) -> None:
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


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("localhost", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("0.0.0.0", False),
        ("::", False),
        ("example.org", False),
    ],
)
def test_loopback_is_known(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


def test_uploads_at_a_time_have_a_quota_a_key(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    keys = {name: make_key(store, "write", max_uploads=2)[1] for name in ("alice", "bob")}

    async def nothing(message: Any = None) -> Any:
        raise AssertionError("nobody reads or answers here")

    async def upload(gate: Gate, name: str, path: str = "/assets/splats") -> None:
        headers = [(b"host", b"localhost"), (b"authorization", bearer(keys[name])["Authorization"].encode())]
        await gate({"type": "http", "method": "PUT", "path": path, "headers": headers}, nothing, nothing)

    async def run() -> None:
        release, inside = anyio.Event(), list[str]()

        async def slow(scope: Any, receive: Any, send: Any) -> None:
            inside.append(scope["state"][CALLER].owner.key)
            await release.wait()
            raise OSError("it broke off")

        gate = Gate(slow, store.keys, ServiceSettings.model_validate({"data": tmp_path}), lambda: False)

        async def broken(name: str, path: str = "/assets/splats") -> None:
            with pytest.raises(OSError, match="broke"):
                await upload(gate, name, path)

        async with anyio.create_task_group() as group:
            for name in ("alice", "alice", "bob"):
                group.start_soon(broken, name)
            group.start_soon(broken, "alice", "/lift")  # no upload
            with anyio.fail_after(60):
                while len(inside) < 4:
                    await anyio.sleep(0.01)
            with pytest.raises(TooMany):
                await upload(gate, "alice")
            release.set()
        await broken("alice")  # what broke off counts no more
        assert len(inside) == 5

    try:
        anyio.run(run)
    finally:
        store.close()


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


def test_key_has_its_own_quota_and_else_that_of_every_key(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    callers: list[Caller] = []

    async def seen(scope: Any, receive: Any, send: Any) -> None:
        callers.append(scope["state"][CALLER])

    async def nothing(message: Any = None) -> Any:
        raise AssertionError("nobody reads or answers here")

    shared = {"key_bytes": 70, "key_queued": 80, "key_uploads": 90}
    gate = Gate(seen, store.keys, ServiceSettings.model_validate({"data": tmp_path, **shared}), lambda: False)

    async def run() -> None:
        for own in ({}, {"max_bytes": 1}, {"max_queued": 2}, {"max_uploads": 3}, {"max_bytes": 0, "max_queued": 0}):
            secret = make_key(store, "read", **own)[1]
            headers = [(b"host", b"localhost"), (b"authorization", f"Bearer {secret}".encode())]
            await gate({"type": "http", "method": "GET", "path": "/jobs", "headers": headers}, nothing, nothing)

    try:
        anyio.run(run)
    finally:
        store.close()
    quotas = [(caller.owner.max_bytes, caller.owner.max_queued, caller.max_uploads) for caller in callers]
    assert quotas == [(70, 80, 90), (1, 80, 90), (70, 2, 90), (70, 80, 3), (0, 0, 90)]


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
