"""Keys and the gate: nobody comes in without one, none does more than it may or sees what is another's."""

from __future__ import annotations

import json
import logging
import re
import sqlite3
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.datastructures import Headers

from liftcore.cli import main
from liftcore.errors import SplatliftError
from service.auth import CALLER, OPEN, AuthMiddleware, Hosts, host_name, is_loopback, required_scope
from service.commands.serve import require_keys
from service.content import EventStreams, is_last
from service.errors import ForeignOrigin, KeyLimitReached, Misconfigured, Misdirected, ServiceUnavailable
from service.models import AssetKind, JobKind, JobState
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.jobs import Event
from service.store.keys import KeyRecord, Quota
from service.store.owners import SERVICE, Owner, Scope
from service.store.store import Store
from tests.crash.conftest import order

from .conftest import app_of, parts_of
from .guarded import KeyedServer, address, bearer, every_route, finish, keyed_server, make_key
from .test_problems import NO_ASSET, UNKNOWN_ID, assert_problem

PATIENCE_SECONDS = 60.0  # for what takes a quarter of a second
DOCS = {"/openapi.json", "/docs", "/docs/swagger-ui-bundle.js", "/docs/swagger-ui.css"}
PAGE = {"/", "/web/page.js", "/web/page.css", "/web/LICENSES.txt"}
PAGE |= {f"/web/example/{name}" for name in ("point_cloud.spz", "cameras.json", "features.safetensors")}
OPEN_ROUTES = {*PAGE, "/healthz", "/readyz", "/version", *DOCS}
# Routes that name nothing of anybody: they show one's own things, or make new ones.
NAMELESS = {("GET", "/metrics"), ("GET", "/assets"), ("PUT", "/assets/{asset}"), ("GET", "/jobs"), ("GET", "/lifts")}
NAMELESS |= {("POST", "/lifts"), ("POST", "/assets"), ("GET", "/key")}
ASKING = {"text": "apple", "view": "v"}
TIMES = {"created": 0, "created_at": ""}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[KeyedServer]:
    with keyed_server(tmp_path / "data", allowed_hosts="Lift.example.org, other.example.org") as new_server:
        yield new_server


def closed_routes(server: KeyedServer) -> list[tuple[str, str]]:
    routes = [(method, path) for method, path in every_route(app_of(server.client)) if path not in OPEN]
    assert len(routes) >= 20
    return routes


def test_every_route_but_the_open_ones_wants_a_key(server: KeyedServer) -> None:
    paths = set()
    for method, path in every_route(app_of(server.client)):
        reply = server.ask(None, method, address(path, server.lift_job, server.order.splats), content=b"{")
        if path in OPEN_ROUTES:
            assert reply.status_code == 200, path
            paths.add(path)
        else:
            assert (reply.status_code, reply.headers["www-authenticate"]) == (401, 'Bearer realm="splatlift"'), path
            assert assert_problem(reply)["type"] == "/problems/unauthorized"
    assert paths == OPEN_ROUTES
    assert server.ask(None, "GET", "/nowhere").status_code == 401


def test_every_route_wants_its_scope(server: KeyedServer) -> None:
    for method, path in closed_routes(server):
        required = required_scope(method, path)
        assert required is not None
        other_scopes = " ".join(scope for scope in Scope if scope not in (required, Scope.ADMIN, Scope.SHARED))
        secret = make_key(server.store, other_scopes)[1]
        reply = server.client.request(
            method, address(path, server.lift_job, server.order.splats), headers=bearer(secret), content=b"{"
        )
        assert reply.status_code == 403, path
        assert f'error="insufficient_scope", scope="{required}"' in reply.headers["www-authenticate"]
        assert assert_problem(reply)["expected"] == f"a key with the scope {required}"
    assert server.store.jobs.get(SERVICE, server.queued).state is JobState.QUEUED


def test_scopes_are_as_documented() -> None:
    parameters = {
        "read": "GET /jobs, HEAD /jobs, POST /query, POST /query/mask, POST /render, GET /healthz/",
        "write": "POST /lift, PUT /assets/splats, DELETE /jobs/x, POST /jobs/x/cancel, POST /queryx, POST /",
        "metrics": "GET /metrics",
    }
    for scope, requests in parameters.items():
        assert {required_scope(*request.split()) for request in requests.split(", ")} == {scope}


def naming(method: str, path: str, job: str, asset: str, server: KeyedServer) -> list[dict[str, Any]]:
    """Requests to a route that name a job, a lift or an asset, once for each place that takes a name."""
    if method == "PATCH" or "/selections" in path or "/shares" in path:
        name = {"encoder" if path.startswith("/assets") else "name": "a name"}
        return [{"json": {"operation": "grow"} if path.endswith("/edits") else name}]
    of_views = {"/photo": {}, "/regions": {"x": 1, "y": 1}, "/regions/mask": {"level": 0, "region": 0}}
    place = next((extra for end, extra in of_views.items() if path.endswith(end)), None)
    if place is not None:
        return [{"params": {"view": "left"} | place}]
    if path in ("/lift", "/lift/plan", "/tradeoff"):
        absent = {"splats": asset, "cameras": asset, "features": [asset]}
        wrong = [{place: name} for place, name in absent.items()]
        if path == "/tradeoff":
            wrong.append({"labels": {"masks": asset, "table": asset, "classes": ["apple"]}})
        return [{"json": server.body() | place} for place in wrong]
    if method == "POST" and (
        path in ("/render", "/query/what", "/query/export") or path.startswith("/query/segment")
    ):
        limits = {
            "/render": {"view": "left"},
            "/query/what": {"example": "splat:1"},
            "/query/export": {"of": "things"},
        }
        return [{"json": limits.get(path, {"words": ["apple"], "view": "left"}) | {"lift": job}}]
    if path.startswith("/query") or path == "/render":
        without_view = dict.fromkeys(
            ("/query/scores", "/query/selection", "/query/splats", "/query/objects"), ("view",)
        )
        unknown = (
            ({"/render": ("text",), "/query/words": ("view",)} | without_view).get(path, ())
            if method == "GET"
            else ()
        )
        parameters = {name: value for name, value in ASKING.items() if name not in unknown} | {"lift": job}
        return [{"json": parameters | {"text": ["apple"]}} if method == "POST" else {"params": parameters}]
    assert "{" in path, f"{method} {path} names nothing: is it open to all, or does it belong into NAMELESS?"
    return [{}]


def test_what_is_anothers_is_absent_on_every_route(server: KeyedServer) -> None:
    asset = server.order.splats
    ids = re.compile("sha256:[0-9a-f]{64}|[0-9a-f]{32}")
    for method, path in closed_routes(server):
        if (method, path) in NAMELESS:
            continue
        job = server.tradeoff_job if "{tradeoff}" in path else server.lift_job
        real = naming(method, path, job, asset, server)
        absent = naming(method, path, UNKNOWN_ID, NO_ASSET, server)
        for options, absent_options in zip(real, absent, strict=True):
            tag = {"headers": {"If-None-Match": "*"}}  # which does not tell that it is there
            reply = server.ask("bob", method, address(path, job, asset), **tag, **options)
            other = server.ask("bob", method, address(path, UNKNOWN_ID, NO_ASSET), **absent_options)
            assert assert_problem(reply)["type"] == "/problems/not-found", f"{method} {path}"
            assert reply.status_code == other.status_code == 404
            texts = [ids.sub("ID", answer.text) for answer in (reply, other)]
            assert texts[0] == texts[1], f"{method} {path}"
    for path in ("/assets", "/jobs", "/lifts"):
        assert list(server.ask("bob", "GET", path).json().values()) == [[], None]
    assert "at least one lift" in server.ask("bob", "GET", "/query", params=ASKING).json()["detail"]
    assert server.ask("alice", "GET", f"/lifts/{server.lift_job}/features").content == b"a lift"
    assert server.ask("alice", "GET", f"/tradeoffs/{server.tradeoff_job}/chart").content == b"a chart"
    assert server.store.jobs.get(SERVICE, server.queued).state is JobState.QUEUED


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


def test_same_bytes_are_of_each_who_uploaded_them(tmp_path: Path, server: KeyedServer) -> None:
    content = b'{"w": 4, "h": 4, "fl_x": 3, "fl_y": 3, "frames": [{"file_path": "a", "transform_matrix":' \
        b' [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}'  # fmt: skip
    first = server.ask("alice", "PUT", "/assets/cameras", content=content)
    asset = first.json()["id"]
    assert first.status_code == 201, first.text
    assert server.ask("bob", "GET", f"/assets/{asset}").status_code == 404  # a digest is no proof
    second = server.ask("bob", "PUT", "/assets/cameras", content=content)
    assert second.status_code == 201  # new to him: that she has it, he does not learn
    assert first.json() | TIMES == second.json() | TIMES
    assert server.ask("bob", "PUT", "/assets/cameras", content=content).status_code == 200
    assert server.ask("bob", "DELETE", f"/assets/{asset}").status_code == 204
    assert server.ask("bob", "GET", f"/assets/{asset}/content").status_code == 404
    assert server.ask("alice", "GET", f"/assets/{asset}/content").content == content
    assert server.ask("alice", "DELETE", f"/assets/{asset}").status_code == 204
    assert not list((tmp_path / "data" / "blobs").rglob("*.json"))


# What is given


def shared_key(server: KeyedServer, **extra: Any) -> dict[str, str]:
    """The header of a key that was given Alice's first lift."""
    return bearer(
        server.store.keys.create("guest", frozenset({Scope.SHARED}), Quota(), lifts=[server.lift_job], **extra)[1]
    )


def test_key_to_a_lift_reads_and_asks_that_one_and_is_let_in_nowhere_else(server: KeyedServer) -> None:
    finish(server.store, b"another lift")  # of Alice, by the job that was in line
    other, asset, guest = server.queued, server.order.splats, shared_key(server)
    allowed_count = refused_count = 0
    for method, path in closed_routes(server):
        lifts = path.startswith(("/lifts", "/query", "/render")) and not path.endswith(("/shares", "/shares/{share}"))
        may = required_scope(method, path) is Scope.READ and (lifts or path == "/key")
        nameless = (method, path) in NAMELESS
        for lift in (server.lift_job, other):
            for options in [{}] if nameless else naming(method, path, lift, asset, server):
                at = address(path, lift, asset)
                reply = server.client.request(method, at, headers=guest, **options)
                if not may:
                    assert assert_problem(reply)["type"] == "/problems/missing-scope", f"{method} {path}"
                    refused_count += 1
                elif nameless:
                    assert reply.status_code == 200, path
                elif lift == other:
                    assert assert_problem(reply)["type"] == "/problems/not-found", f"{method} {path}"
                else:
                    response = server.ask("alice", method, at, **options)
                    assert reply.status_code == response.status_code, f"{method} {path}"
                    allowed_count += 1
    assert allowed_count >= 20 and refused_count >= 20
    assert [entry["id"] for entry in server.client.get("/lifts", headers=guest).json()["lifts"]] == [server.lift_job]
    assert server.client.get(f"/lifts/{server.lift_job}/features", headers=guest).content == b"a lift"
    assert server.client.get("/key", headers=guest).json()["lifts"] == [server.lift_job]


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


def test_owner_gives_a_lift_to_a_key_and_takes_it_away(server: KeyedServer) -> None:
    at = f"/lifts/{server.lift_job}/shares"
    reply = server.ask("alice", "POST", at, json={"name": "Bob from the lab", "expires_s": 3600})
    assert reply.status_code == 201 and reply.headers["cache-control"] == "no-store"
    share = reply.json()
    assert share["links"]["page"] == f"/?lift={server.lift_job}#key={share['key']}"
    assert share["expires"] == pytest.approx(time.time() + 3600, abs=60) and share["expires_at"].endswith("Z")
    guest = bearer(share["key"])
    assert server.client.get("/key", headers=guest).json()["name"] == "Bob from the lab"
    assert server.client.get(f"/lifts/{server.lift_job}", headers=guest).status_code == 200
    (listed_share,) = server.ask("alice", "GET", at).json()["shares"]
    assert listed_share["id"] == share["id"] and share["key"] not in str(listed_share)
    assert [server.ask(name, "GET", at).status_code for name in ("bob", "boss")] == [404, 200]
    assert server.ask("bob", "DELETE", share["links"]["self"]).status_code == 404
    assert server.ask("alice", "DELETE", share["links"]["self"]).status_code == 204
    assert server.client.get(f"/lifts/{server.lift_job}", headers=guest).status_code == 401
    assert server.ask("alice", "DELETE", share["links"]["self"]).status_code == 404
    for wrong in ({}, {"name": ""}, {"name": "x", "expires_s": 1}, {"name": "x", "scopes": ["admin"]}):
        assert assert_problem(server.ask("alice", "POST", at, json=wrong))["status"] == 422


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


def share_of(server: KeyedServer, secret: str, **extra: Any) -> dict[str, str]:
    """The header of a key that Alice's first lift is shared with, by a key of hers."""
    body = {"name": "guest", **extra}
    reply = server.client.post(f"/lifts/{server.lift_job}/shares", headers=bearer(secret), json=body)
    assert reply.status_code == 201, reply.text
    return bearer(reply.json()["key"])


def may_read(server: KeyedServer, guest: dict[str, str]) -> bool:
    return server.client.get(f"/lifts/{server.lift_job}", headers=guest).status_code == 200


@pytest.mark.parametrize("options", [[], ["--grace", "1h"], ["--keep-shares"]])
def test_shares_end_with_the_secret_that_made_them_unless_they_are_kept(
    options: list[str], server: KeyedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other, guest = share_of(server, server.secrets["boss"]), share_of(server, server.secrets["alice"])
    rotate = ["keys", "rotate", server.ids["alice"], *options, "--data", str(tmp_path / "data")]
    assert main(rotate) == 0
    output = capsys.readouterr()
    new = bearer(output.out.strip())
    assert ("of guest" in output.err) == ("--keep-shares" not in options)
    assert may_read(server, other) and may_read(server, new) and may_read(server, guest) == bool(options)
    if options == ["--grace", "1h"]:
        # With the secret before, which still counts.
        late = share_of(server, server.secrets["alice"], expires_s=86_400)
        for ending in (guest, late, bearer(server.secrets["alice"])):
            expires = server.client.get("/key", headers=ending).json()["expires"]
            assert expires == pytest.approx(time.time() + 3600, abs=60)
        soon = share_of(server, server.secrets["alice"], expires_s=600)  # which ends before that secret
        response = share_of(server, output.out.strip())
        assert main(rotate) == 0  # the first secret ends now
        assert not may_read(server, late) and not may_read(server, soon) and may_read(server, response)


@pytest.mark.parametrize("grace", [0.0, 3600.0])
def test_share_that_is_asked_for_in_the_moment_of_a_rotation_ends_as_the_secret_that_asked(
    grace: float, server: KeyedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_lift = server.store.keys.of_lift

    def rotate_first(lift: str) -> list[KeyRecord]:
        server.store.keys.rotate(server.ids["alice"], grace=grace)
        return of_lift(lift)

    monkeypatch.setattr(server.store.keys, "of_lift", rotate_first)  # which is asked after the gate
    reply = server.ask("alice", "POST", f"/lifts/{server.lift_job}/shares", json={"name": "guest"})
    if grace:
        assert reply.json()["expires"] == pytest.approx(time.time() + grace, abs=60)
    else:
        assert assert_problem(reply)["type"] == "/problems/unauthorized"
        assert reply.headers["www-authenticate"] and not of_lift(server.lift_job)


def test_lift_that_goes_while_it_is_changed_or_read_is_absent(
    server: KeyedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    at, write, open_file = f"/lifts/{server.lift_job}", server.store.database.write, Path.open

    def write_late(**options: Any) -> Any:
        monkeypatch.undo()
        server.store.jobs.delete(SERVICE, server.lift_job, given_up=(JobKind.LIFT,))
        return write(**options)

    def open_lost(path: Path, *options: Any, **keywords: Any) -> Any:
        if path.name.startswith(server.lift_job):
            path.unlink()
        return open_file(path, *options, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", open_lost)
        assert assert_problem(server.ask("alice", "GET", f"{at}/features"))["type"] == "/problems/not-found"
    monkeypatch.setattr(server.store.database, "write", write_late)
    assert assert_problem(server.ask("alice", "PATCH", at, json={"name": "x"}))["type"] == "/problems/not-found"


def test_revoked_key_names_the_shares_that_end_with_it(
    server: KeyedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    guest, data_option = share_of(server, server.secrets["alice"]), ["--data", str(tmp_path / "data")]
    assert main(["keys", "revoke", server.ids["alice"], *data_option]) == 0
    assert "1 that it made" in capsys.readouterr().out and not may_read(server, guest)
    assert main(["keys", "list", *data_option]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if f"by {server.ids['alice']}" in line]
    assert "revoked" in line


@pytest.mark.parametrize("moment", [1e18, 253_402_300_800.0, float("inf"), -1e18, float("-inf")])
def test_moments_beyond_the_calendar_are_shown_as_its_ends(
    moment: float, server: KeyedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    share_of(server, server.secrets["alice"])
    with server.store.database.write() as connection:
        never_before = moment if moment > 0 else None  # else nobody would be let in
        connection.execute("UPDATE keys SET created = ?, expires = ?", (moment, never_before))
        connection.execute("UPDATE jobs SET created = ?1, started = ?1, ended = ?1", (moment,))
        connection.execute("UPDATE lifts SET created = ?", (moment,))
    end = "9999-12-31" if moment > 0 else "0001-01-01"
    for path in ("/jobs", f"/jobs/{server.lift_job}", "/lifts", f"/lifts/{server.lift_job}/shares", "/key"):
        reply = server.ask("alice", "GET", path)
        assert reply.status_code == 200 and (f"{end}T00:00:00" in reply.text or path == "/key"), reply.text
    assert main(["keys", "list", "--data", str(tmp_path / "data")]) == 0
    assert end in capsys.readouterr().out


def test_lifts_are_given_by_the_command_line_with_no_other_scope(
    server: KeyedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    create = ["keys", "create", "--name", "guest", "--data", str(tmp_path / "data")]
    assert main([*create, "--lifts", server.lift_job]) == 0
    guest = bearer(capsys.readouterr().out.strip())
    assert server.client.get(f"/lifts/{server.lift_job}", headers=guest).status_code == 200
    own_lift = ["--lifts", server.lift_job]
    for wrong in (["--lifts", UNKNOWN_ID], [*own_lift, "--scopes", "read"], ["--scopes", "shared"], []):
        assert main([*create, *wrong]) == 2, wrong
        assert "splatlift: " in capsys.readouterr().err


# Making and revoking


def test_open_until_the_first_key_and_never_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with keyed_server(tmp_path / "data") as server:
        with server.store.database.write() as connection:
            connection.execute("DELETE FROM keys")
            connection.execute("UPDATE jobs SET owner = ''")
            connection.execute("UPDATE asset_owners SET owner = ''")
        (tmp_path / "data" / "keys.required").unlink()  # as if there never had been one
        assert server.ask(None, "GET", "/jobs").status_code == 200
        assert len(server.ask(None, "GET", "/lifts").json()["lifts"]) == 1
        assert "security" not in str(server.ask(None, "GET", "/openapi.json").json()["paths"])
        data_option = ["--data", str(tmp_path / "data")]
        # While the server runs.
        assert main(["keys", "create", "--name", "first", "--scopes", "read", *data_option]) == 0
        secret = capsys.readouterr().out.strip()
        assert server.ask(None, "GET", "/jobs").status_code == 401
        require_keys(ServiceSettings.model_validate({"data": tmp_path / "data", "host": "0.0.0.0"}))
        response = server.client.get("/jobs", headers=bearer(secret))
        assert response.status_code == 200 and response.json()["jobs"] == []  # what was before keys is of admins
        _, admin = make_key(server.store, "admin")
        assert len(server.client.get("/jobs", headers=bearer(admin)).json()["jobs"]) == 3
        assert main(["keys", "list", *data_option]) == 0
        line = capsys.readouterr().out.splitlines()[0].split()
        assert secret not in " ".join(line) and "valid" in line
        assert main(["keys", "revoke", line[0], *data_option]) == 0
        assert "revoked" in capsys.readouterr().out
        response = server.client.get("/jobs", headers=bearer(secret))
        assert response.status_code == 401 and 'error="invalid_token"' in response.headers["www-authenticate"]
        assert server.ask(None, "GET", "/jobs").status_code == 401
        document = server.ask(None, "GET", "/openapi.json").json()
        assert document["paths"]["/lift"]["post"]["security"] == [{"key": ["write"]}]
        assert "security" not in document["paths"]["/healthz"]["get"]


@pytest.mark.parametrize("grace", ["1h", None])
def test_rotated_key_has_a_new_secret_and_keeps_what_is_its_own(
    grace: str | None, server: KeyedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, data_option = server.secrets["alice"], ["--data", str(tmp_path / "data")]
    assert (
        main(["keys", "rotate", server.ids["alice"], *([] if grace is None else ["--grace", grace]), *data_option])
        == 0
    )
    new = capsys.readouterr().out.strip()
    assert server.client.get(f"/jobs/{server.lift_job}", headers=bearer(new)).status_code == 200
    assert server.client.get("/jobs", headers=bearer(old)).status_code == (401 if grace is None else 200)
    with server.store.database.write() as connection:
        connection.execute("UPDATE keys SET old_until = ?", (time.time(),))
    assert server.client.get("/jobs", headers=bearer(old)).status_code == 401
    server.store.keys.revoke(server.ids["alice"])
    assert server.client.get("/jobs", headers=bearer(new)).status_code == 401


def test_key_is_rotated_by_its_name_where_one_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data_option = ["--data", str(tmp_path)]
    for name in ("anna", "bob", "bob"):
        assert main(["keys", "create", "--name", name, "--scopes", "read", *data_option]) == 0
    assert main(["keys", "rotate", "anna", *data_option]) == 0
    capsys.readouterr()
    for name, message in (("bob", "name one of"), ("nobody", "valid key")):
        assert main(["keys", "rotate", name, *data_option]) == 2
        assert message in capsys.readouterr().err


def test_key_expires_and_stays_revoked_since_the_first_time(server: KeyedServer) -> None:
    key, secret = server.store.keys.create("guest", frozenset({Scope.READ}), Quota(), expires=time.time() + 3600)
    assert server.client.get("/jobs", headers=bearer(secret)).status_code == 200
    assert server.store.keys.revoke(server.ids["bob"])[0].revoked is not None
    with server.store.database.write() as connection:
        connection.execute("UPDATE keys SET expires = ? WHERE id = ?", (time.time(), key.id))
        connection.execute("UPDATE keys SET revoked = 7 WHERE id = ?", (server.ids["bob"],))
    response = server.client.get("/jobs", headers=bearer(secret))
    assert response.status_code == 401 and 'error="invalid_token"' in response.headers["www-authenticate"]
    assert server.store.keys.revoke(server.ids["bob"])[0].revoked == 7


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


def test_keys_speak_json_and_say_until_when_they_are_valid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run_json(*arguments: str) -> Any:
        assert main(["keys", *arguments, "--json", "--data", str(tmp_path / "new" / "data")]) == 0
        return json.loads(capsys.readouterr().out)

    created = run_json("create", "--name", "x", "--scopes", "write,read", "--max-bytes", "5", "--max-uploads", "2")
    secret = created.pop("key")
    assert (created["scopes"], created["revoked"]) == (["read", "write"], None)
    assert (created["max_bytes"], created["max_queued"], created["max_uploads"]) == (5, None, 2)
    assert run_json("list") == {"keys": [created]} and secret not in str(created)
    response = run_json("revoke", created["id"])
    assert response.pop("ended_shares") == []
    assert response["revoked"] >= created["created"] and run_json("list") == {"keys": [response]}
    for text, seconds in (("30d", 30 * 86_400), ("12h", 43_200), ("2999-12-31", None)):
        start = time.time()
        expires = run_json("create", "--name", "y", "--scopes", "read", "--expires", text)["expires"]
        expected = datetime(2999, 12, 31, tzinfo=UTC).timestamp() if seconds is None else start + seconds
        assert expected <= expires <= expected + (time.time() - start if seconds else 0)
    assert main(["keys", "list", "--data", str(tmp_path / "new" / "data")]) == 0
    assert capsys.readouterr().out.count("valid until") == 3


@pytest.mark.parametrize(
    "arguments",
    [
        ["create", "--name", "x", "--scopes", "everything"],
        ["create", "--name", "x", "--scopes", ","],
        ["create", "--name", " ", "--scopes", "read"],
        ["create", "--name", "a\nb", "--scopes", "read"],
        ["create", "--name", "x", "--scopes", "read", "--expires", "soon"],
        *(
            ["create", "--name", "x", "--scopes", "read", "--expires", expiry]
            for expiry in (
                "1999-12-31",
                "0001-01-01T00:00:00+14:00",
                "9999-12-31T23:59:59-23:59",
                "10000-01-01",
                "0d",
                "nan",
                "inf",
                "1e400d",
                "9999999d",
                "",
            )
        ),
        ["rotate", "nobody", "--grace", "9999999d"],
        ["rotate", "nobody"],
        ["rotate", "nobody", "--grace", "long"],
        ["revoke", "nobody"],
    ],
)
def test_bad_commands_about_keys_are_one_line(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Store.open(tmp_path).close()
    assert main(["keys", *arguments, "--data", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("splatlift: ") and err.count("\n") == 1
    assert main(["keys", "list", "--data", str(tmp_path / "nowhere")]) == 2
    assert not (tmp_path / "nowhere").exists()


def test_keys_are_not_made_in_a_database_of_an_older_release(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Store.open(tmp_path)
    try:
        with store.database.write() as connection:
            connection.execute("PRAGMA user_version = 1")
        assert main(["keys", "create", "--name", "x", "--scopes", "read", "--data", str(tmp_path)]) == 2
        assert "release 0.4.0" in capsys.readouterr().err
    finally:
        store.close()


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


def test_gate_answers_with_problems(server: KeyedServer) -> None:
    reply = server.ask("alice", "GET", "/jobs", headers={"Host": "evil.example"})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/misdirected", 421)
    assert server.ask(None, "GET", "/healthz", headers={"Host": "evil.example"}).status_code == 421
    assert server.ask("alice", "GET", "/jobs", headers={"Host": "LIFT.example.org:80"}).status_code == 200
    reply = server.ask("alice", "POST", f"/jobs/{server.queued}/cancel", headers={"Origin": "https://evil.example"})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/foreign-origin", 403)
    assert "access-control-allow-origin" not in reply.headers
    limits = server.ask("alice", "POST", f"/jobs/{server.queued}/cancel", headers={"Origin": "http://127.0.0.1"})
    assert limits.status_code == 200


LAB = "https://lab.example"
PREFLIGHT = {"Origin": LAB, "Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization"}


def test_no_page_of_another_site_reads_unless_it_is_named(server: KeyedServer) -> None:
    assert server.ask(None, "OPTIONS", "/jobs", headers=PREFLIGHT).status_code >= 400
    reply = server.ask("alice", "GET", "/jobs", headers={"Origin": LAB})
    assert not [name for name in reply.headers if name.startswith("access-control")]


def test_pages_of_named_origins_read_with_a_key_and_change_nothing(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", cors_origins=f"http://localhost:3000, {LAB}") as server:
        preflight = server.ask(None, "OPTIONS", "/jobs", headers=PREFLIGHT)
        assert preflight.status_code == 200 and preflight.headers["access-control-allow-origin"] == LAB
        assert "authorization" in preflight.headers["access-control-allow-headers"].lower()
        for name, status in (("alice", 200), (None, 401)):  # refusals are read, too
            reply = server.ask(name, "GET", "/jobs", headers={"Origin": LAB})
            assert (reply.status_code, reply.headers["access-control-allow-origin"]) == (status, LAB)
            assert "access-control-allow-credentials" not in reply.headers
            assert "X-Request-ID" in reply.headers["access-control-expose-headers"]
        parameters = {"json": {"text": ["apple"], "lift": UNKNOWN_ID}, "headers": {"Origin": LAB}}
        assert server.ask("alice", "POST", "/query", **parameters).status_code == 404  # a question reads
        response = server.ask("alice", "POST", f"/jobs/{server.queued}/cancel", headers={"Origin": LAB})
        assert assert_problem(response)["type"] == "/problems/foreign-origin"
        other = server.ask("alice", "GET", "/jobs", headers={"Origin": "https://evil.example"})
        assert "access-control-allow-origin" not in other.headers
        parameters["headers"] = {"Origin": "https://evil.example"}
        assert (
            assert_problem(server.ask("alice", "POST", "/query", **parameters))["type"] == "/problems/foreign-origin"
        )


@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("Origin", "https://evil.example"),
        ("Access-Control-Request-Method", "DELETE"),
        ("Access-Control-Request-Headers", "authorization, x-other"),
        ("Access-Control-Request-Headers", "authorization,,accept"),
        ("Access-Control-Request-Private-Network", "true"),
    ],
)
def test_preflight_that_is_refused_is_a_problem(header: str, value: str, tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", cors_origins=LAB) as server:
        reply = server.ask(None, "OPTIONS", "/jobs", headers=PREFLIGHT | {header: value})
        problem = assert_problem(reply)
        assert problem["argument"] == header and value in problem["got"]


@pytest.mark.parametrize("origins", ["*", "lab.example", "https://lab.example/", "null", "https://*.example"])
def test_origins_that_no_browser_sends_are_refused_and_all_only_where_keys_are_required(
    origins: str, tmp_path: Path
) -> None:
    with pytest.raises(Misconfigured, match="cors_origins"):
        ServiceSettings.model_validate({"data": tmp_path, "cors_origins": origins})
    assert ServiceSettings.model_validate({"cors_origins": "*", "keys": "required"}).cors_origins == ("*",)


def gate_of(store: Store, app: Any, **settings: int) -> AuthMiddleware:
    server_settings = ServiceSettings.model_validate({"data": store.files.root, **settings})
    return AuthMiddleware(app, store.keys, server_settings, lambda: False)


async def through(gate: AuthMiddleware, secret: str, path: str = "/assets/splats", method: str = "PUT") -> None:
    """A request with a key, of which nobody reads or answers anything."""
    headers = [(b"host", b"localhost"), (b"authorization", f"Bearer {secret}".encode())]
    response: Any = None
    await gate({"type": "http", "method": method, "path": path, "headers": headers}, response, response)


def test_uploads_and_plans_at_a_time_have_a_quota_a_key(store: Store) -> None:
    alice, bob = (make_key(store, "write", max_uploads=2)[1] for _ in range(2))

    async def run() -> None:
        release, inside = anyio.Event(), list[str]()

        async def slow(scope: Any, receive: Any, send: Any) -> None:
            inside.append(scope["state"][CALLER].owner.key)
            await release.wait()
            raise OSError("it broke off")

        async def broken(*parameters: str) -> None:
            with pytest.raises(OSError, match="broke"):
                await through(gate, *parameters)

        gate = gate_of(store, slow)
        async with anyio.create_task_group() as group:
            plan = ("/lift/plan", "POST")  # takes a process, as uploads do
            for parameters in ((alice,), (alice, *plan), (bob,), (alice, "/lift", "POST")):  # which takes none
                group.start_soon(broken, *parameters)
            with anyio.fail_after(60):
                while len(inside) < 4:
                    await anyio.sleep(0.01)
            for parameters, noun in (((alice,), "upload"), ((alice, *plan), "plan")):
                with pytest.raises(KeyLimitReached, match=noun):
                    await through(gate, *parameters)
            release.set()
        await broken(alice)  # what broke off counts no more
        assert len(inside) == 5

    anyio.run(run)


def test_key_has_its_own_quota_and_else_that_of_every_key(store: Store) -> None:
    quotas: list[tuple[int | None, int | None, int]] = []

    async def record_key(scope: Any, receive: Any, send: Any) -> None:
        caller = scope["state"][CALLER]
        quotas.append((caller.owner.max_bytes, caller.owner.max_queued, caller.max_uploads))

    gate = gate_of(store, record_key, key_bytes=70, key_queued=80, key_uploads=90)
    for limits in ({}, {"max_bytes": 1}, {"max_queued": 2}, {"max_uploads": 3}, {"max_bytes": 0, "max_queued": 0}):
        anyio.run(through, gate, make_key(store, "write", **limits)[1])
    assert quotas == [(70, 80, 90), (1, 80, 90), (70, 2, 90), (70, 80, 3), (0, 0, 90)]


def test_streams_at_a_time_have_a_share_a_key() -> None:
    streams = EventStreams(4, 2)

    def follow(key: str | None) -> None:
        streams.answer(lambda number: [], lambda event: "", 0, key)

    for key in ("alice", "alice", "bob"):
        follow(key)
    with pytest.raises(KeyLimitReached):
        follow("alice")
    follow(None)  # while there are no keys there are no shares
    with pytest.raises(ServiceUnavailable):
        follow("bob")
    streams = EventStreams(2, 8)  # a share is never all of them
    follow("alice")
    with pytest.raises(KeyLimitReached):
        follow("alice")


def test_database_that_is_held_at_the_gate_is_503_with_retry_after(server: KeyedServer, monkeypatch: Any) -> None:
    lock_error = sqlite3.OperationalError("database is locked")
    lock_error.sqlite_errorcode = sqlite3.SQLITE_BUSY
    monkeypatch.setattr(server.store.database, "read", mock.Mock(side_effect=lock_error))
    reply = server.ask("alice", "GET", "/jobs")
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
    assert int(reply.headers["retry-after"]) > 0


def test_stored_bytes_have_a_quota(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", key_bytes=10_000) as server:
        used_bytes = sum(asset["bytes"] for asset in server.ask("alice", "GET", "/assets").json()["assets"]) + len(
            b"a lift"
        )
        ident, secret = make_key(server.store, "read write", max_bytes=used_bytes)
        with server.store.database.write() as connection:
            connection.execute("UPDATE asset_owners SET owner = ?", (ident,))
            connection.execute("UPDATE jobs SET owner = ?", (ident,))
        replies = [
            server.client.put("/assets/splats", headers=bearer(secret), content=b"x"),
            server.client.post("/lift", headers=bearer(secret), json=server.body()),
        ]
        for reply in replies:
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/over-quota", 403)
            assert str(used_bytes) in reply.json()["expected"]
        assert (
            server.client.delete(f"/jobs/{server.lift_job}?with_lift=true", headers=bearer(secret)).status_code == 204
        )
        reply = server.client.post("/lift", headers=bearer(secret), json=server.body())
        assert reply.status_code == 403  # the trade-off counts, too
        response = server.client.delete(f"/jobs/{server.tradeoff_job}?with_tradeoff=true", headers=bearer(secret))
        assert response.status_code == 204
        assert server.client.post("/lift", headers=bearer(secret), json=server.body()).status_code == 202


def test_jobs_in_line_have_a_quota_a_key(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data", key_queued=2) as server:
        assert server.ask("alice", "POST", "/lift", json=server.body()).status_code == 202
        reply = server.ask("alice", "POST", "/lift", json=server.body())
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/too-many", 429)
        assert int(reply.headers["retry-after"]) > 0
        order(server.store, Owner(server.ids["bob"], sees_all=False))
        assert server.ask("bob", "POST", "/lift", json=server.body()).status_code == 202
        for _ in "ba":  # keys take turns, and hers was the last
            finish(server.store, b"")
        assert server.ask("alice", "POST", "/lift", json=server.body()).status_code == 202
