"""Keys and the gate: nobody comes in without one, none does more than it may or sees what is another's."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.datastructures import Headers

from liftcore.errors import SplatliftError
from service.auth import OPEN, Hosts, host_name, is_loopback, required_scope
from service.content import is_last
from service.errors import ForeignOrigin, Misdirected
from service.models import AssetKind
from service.store.assets import CheckedUpload
from service.store.jobs import Event
from service.store.keys import Quota
from service.store.owners import Owner, Scope

from .conftest import parts_of
from .guarded import KeyedServer, bearer, keyed_server
from .test_problems import NO_ASSET, assert_problem

PATIENCE_SECONDS = 60.0  # for what takes a quarter of a second
PAGE = {"/", "/web/page.js", "/web/page.css", "/web/LICENSES.txt"}
PAGE |= {f"/web/example/{name}" for name in ("point_cloud.spz", "cameras.json", "features.safetensors")}
# Routes that name nothing of anybody: they show one's own things, or make new ones.
NAMELESS = {("GET", "/metrics"), ("GET", "/assets"), ("PUT", "/assets/{asset}"), ("GET", "/jobs"), ("GET", "/lifts")}
NAMELESS |= {("POST", "/lifts"), ("POST", "/assets"), ("GET", "/key")}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[KeyedServer]:
    with keyed_server(tmp_path / "data", allowed_hosts="Lift.example.org, other.example.org") as new_server:
        yield new_server


def test_scopes_are_as_documented() -> None:
    parameters = {
        "read": "GET /jobs, HEAD /jobs, POST /query, POST /query/mask, POST /render, GET /healthz/",
        "write": "POST /lift, PUT /assets/splats, DELETE /jobs/x, POST /jobs/x/cancel, POST /queryx, POST /",
        "metrics": "GET /metrics",
    }
    for scope, requests in parameters.items():
        assert {required_scope(*request.split()) for request in requests.split(", ")} == {scope}


def test_admins_see_and_touch_everything(server: KeyedServer) -> None:
    assert [len(server.ask("boss", "GET", path).json()[path[1:]]) for path in ("/assets", "/jobs", "/lifts")] == [
        3,
        3,
        1,
    ]
    assert server.ask("boss", "GET", f"/assets/{server.order.splats}/content").status_code == 200
    assert server.ask("boss", "POST", f"/jobs/{server.queued}/cancel").status_code == 200
    assert server.ask("boss", "DELETE", f"/jobs/{server.lift_job}?with_lift=true").status_code == 204
    assert server.ask("alice", "GET", f"/jobs/{server.lift_job}").status_code == 404


# What is given


def shared_key(server: KeyedServer, **extra: Any) -> dict[str, str]:
    """The header of a key that was given Alice's first lift."""
    return bearer(
        server.store.keys.create("guest", frozenset({Scope.SHARED}), Quota(), lifts=[server.lift_job], **extra)[1]
    )


def test_key_to_a_lift_asks_with_no_other_asset_of_its_owner(server: KeyedServer, tmp_path: Path) -> None:
    alice = Owner(server.ids["alice"], sees_all=False)
    with server.store.files.draft(".safetensors") as draft:
        draft.write_bytes(b"a table")
        upload = CheckedUpload(draft, AssetKind.TABLE, "f" * 64, ".safetensors", {"words": ["apple"]}, [])
        table = server.store.assets.add(alice, upload)[0].id
    guest, texts = shared_key(server), set()
    for entry in (table, NO_ASSET):
        parameters = {"text": "apple", "lift": server.lift_job, "table": entry}
        reply = server.client.get("/query", params=parameters, headers=guest)
        assert assert_problem(reply)["type"] == "/problems/not-found"
        texts.add(reply.text.replace(entry, "ID").partition('"request_id"')[0])
    assert len(texts) == 1


@pytest.mark.parametrize("end", ["expired", "revoked", "maker revoked", "lift deleted"])
def test_shared_key_ends(end: str, server: KeyedServer) -> None:
    guest, key = shared_key(server, maker=server.secrets["alice"]), server.store.keys.of_lift(server.lift_job)[0].id
    assert server.client.get("/lifts", headers=guest).status_code == 200
    match end:
        case "expired":
            with server.store.database.write() as connection:
                connection.execute("UPDATE keys SET expires = ? WHERE id = ?", (time.time(), key))
        case "revoked":
            server.store.keys.revoke(key)
        case "maker revoked":
            server.store.keys.revoke(server.ids["alice"])
        case _:
            assert server.ask("alice", "DELETE", f"/lifts/{server.lift_job}").status_code == 204
            assert server.client.get("/lifts", headers=guest).json()["lifts"] == []
            assert server.client.get(f"/lifts/{server.lift_job}", headers=guest).status_code == 404
            return
    assert server.client.get("/lifts", headers=guest).status_code == 401


# Making and revoking


def test_log_names_client_and_key_and_every_use_of_admin_and_no_secret(
    server: KeyedServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    secret = server.secrets["alice"]
    assert len(secret) >= len("splatlift_") + 43  # 256 bits in base64
    with caplog.at_level(logging.DEBUG):
        server.ask("alice", "GET", "/lifts/nothing", params={"access_token": secret})
        server.ask(None, "GET", "/jobs")
        server.ask("boss", "DELETE", "/jobs/nothing")
    log_fields = [vars(record)["fields"] for record in caplog.records if record.name == "service.access"]
    assert [fields["client"] for fields in log_fields] == ["testclient"] * 3
    assert [fields.get("key") for fields in log_fields] == [server.ids["alice"], None, server.ids["boss"]]
    assert ["admin" in fields for fields in log_fields] == [False, False, True]
    (use,) = [vars(record)["fields"] for record in caplog.records if record.getMessage() == "an admin key is used"]
    assert (use["key"], use["method"], use["path"]) == (server.ids["boss"], "DELETE", "/jobs/nothing")
    messages = [
        str(vars(record)) for record in caplog.records if not record.name.startswith("http")
    ]  # not the client's
    assert messages and not any(secret in line for line in messages)
    files = [path for path in (tmp_path / "data").rglob("*") if path.is_file()]
    assert files and not any(secret.encode() in path.read_bytes() for path in files)


def test_revoked_key_loses_its_streams(server: KeyedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    replies, event_sent = list[Any](), threading.Event()

    def record_event(event: Event) -> bool:  # asked when the event is on its way
        event_sent.set()
        return is_last(event)

    monkeypatch.setattr("service.content.is_last", record_event)

    def follow() -> None:
        replies.append(server.ask("alice", "GET", f"/jobs/{server.queued}/events"))  # its job does not end

    following = threading.Thread(target=follow, daemon=True)
    following.start()
    assert event_sent.wait(PATIENCE_SECONDS) and parts_of(server.client).streams.open == 1
    server.store.keys.revoke(server.ids["alice"])
    following.join(PATIENCE_SECONDS)
    (reply,) = replies
    assert reply.status_code == 200 and '"queued"' in reply.text
    assert server.ask("alice", "GET", "/jobs").status_code == 401


def test_only_one_whole_key_as_bearer_counts(server: KeyedServer) -> None:
    secret, other = server.secrets["alice"], server.secrets["bob"]
    for header in ("", "Bearer", "Bearer ", f"Basic {secret}", secret, f"Bearer {secret} x", f"Bearer {secret[:-1]}"):
        assert server.client.get("/jobs", headers={"Authorization": header}).status_code == 401
    twice = [("Authorization", f"Bearer {entry}") for entry in (secret, other)]
    assert server.client.get("/jobs", headers=twice).status_code == 401
    assert server.client.get("/jobs", params={"access_token": secret}).status_code == 401  # nor in URLs
    assert server.client.get("/jobs", headers={"Authorization": f"bearer  {secret}"}).status_code == 200


# The gate: which hosts and pages may ask, and how much


HOSTS = Hosts("127.0.0.1", ["lift.example.org"])
EVERYWHERE = Hosts("0.0.0.0", [])


def check(hosts: Hosts, method: str = "GET", **headers: str) -> None:
    hosts.check(method, Headers(headers))


def test_own_names_are_taken_and_no_other() -> None:
    for host in ("localhost", "LOCALHOST:8787", "127.0.0.1:1", "[::1]:8787", "[::1]", "lift.example.org:443",
                 "localhost.", "localhost:"):  # fmt: skip
        check(HOSTS, host=host)
    for host in ("evil.example", "evil.example:8787", "localhost.evil.example", "127.0.0.1.evil.example", "", ":80",
                 "[::1", "192.0.2.1", "localhost:port", "localhost@evil.example", "evil.example@localhost",
                 "[localhost]", "[]"):  # fmt: skip
        with pytest.raises(Misdirected):
            check(HOSTS, host=host)
    for hosts in ([], [(b"host", b"localhost"), (b"host", b"localhost")]):  # none, and two
        with pytest.raises(Misdirected):
            HOSTS.check("GET", Headers(raw=hosts))


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
        check(HOSTS, "POST", host=text, origin=text)
    except SplatliftError:
        return
    assert host_name(text) in ("localhost", "127.0.0.1", "::1", "lift.example.org")


@given(st.sampled_from(["GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "BREW"]), st.text(max_size=20))
def test_what_is_not_listed_as_open_wants_a_scope(method: str, rest: str) -> None:
    for path in ("/" + rest, *(f"{path}{rest}" for path in OPEN)):
        assert (required_scope(method, path) is None) == (method in ("GET", "HEAD") and path in OPEN)


def test_own_page_may_change_things_and_foreign_ones_only_look() -> None:
    for origin in ("http://localhost:8787", "https://lift.example.org", "http://LOCALHOST:8787"):
        check(HOSTS, "POST", host="localhost:8787", origin=origin)
    for origin in ("https://evil.example", "null", "", "http://localhost:3000", "http://localhost", "file://",
                   "localhost:8787", "http://["):  # fmt: skip
        check(HOSTS, "GET", host="localhost:8787", origin=origin)  # without CORS headers no page can read the answer
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            with pytest.raises(ForeignOrigin):
                check(HOSTS, method, host="localhost:8787", origin=origin)


def test_database_that_is_held_at_the_gate_is_503_with_retry_after(server: KeyedServer, monkeypatch: Any) -> None:
    lock_error = sqlite3.OperationalError("database is locked")
    lock_error.sqlite_errorcode = sqlite3.SQLITE_BUSY
    monkeypatch.setattr(server.store.database, "read", mock.Mock(side_effect=lock_error))
    reply = server.ask("alice", "GET", "/jobs")
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
    assert int(reply.headers["retry-after"]) > 0
