"""Keys: nobody comes in without one, none does more than it may, nobody sees what is another's; with one, the
service does what its OpenAPI document says.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.server import PATIENCE_SECONDS, Server, run_command, until
from tests.tiny_scene import TinyScene

from .over_http import (
    NO_ASSET,
    NO_ID,
    address_of,
    assert_problem,
    bearer,
    lift_of,
    operations_of,
    request_to,
    upload_scene,
)

OPEN = {"/healthz", "/readyz", "/openapi.json", "/docs", "/"}
OWN_ROUTES = {"/key", "/metrics"}  # of whoever asks, and of operators
IDS = re.compile("sha256:[0-9a-f]{64}|[0-9a-f]{32}")
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "response_headers_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method",
    "allow_header_conformance", "use_after_free", "ensure_resource_availability", "ignored_auth",
)  # fmt: skip
# What breaks the schema by its length may break the limit of a body first.
REFUSALS = """[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 406, 409, 412, 413, 414, 415, 422, 428, 429]
"""
# A longer head is answered by uvicorn (docs/service.md).
HOOKS = """import schemathesis
from urllib.parse import urlencode
@schemathesis.hook
def filter_query(context, query):
    return len(urlencode(query or {}, doseq=True, errors="replace")) < 60_000
"""
CONTRACT_SECONDS = 1500.0  # that schemathesis may take; a busy machine needs more


def create_key(server: Server, *options: str) -> dict[str, Any]:
    """Make a key by the command line; return its document, with the secret."""
    return json.loads(run_command("keys", "create", *options, "--json", data=server.data))


@dataclass(frozen=True)
class Keyed:
    """A server with keys; Alice has two lifts."""

    server: Server
    secrets: dict[str, str]
    order: dict[str, Any]
    lifts: tuple[str, str]

    def ask(self, name: str | None, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request with somebody's key, or without one."""
        headers = options.pop("headers", {}) | ({} if name is None else bearer(self.secrets[name]))
        return self.server.client.request(method, path, headers=headers, **options)

    def operations(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Yield method, path template and description of each operation that needs a key."""
        yield from (entry for entry in operations_of(self.server.client) if entry[1] not in OPEN)


@pytest.fixture(scope="module")
def keyed(tiny: TinyScene, encoder: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    data = tmp_path_factory.mktemp("keyed") / "data"
    with Server(data, encoder=encoder, allowed_hosts="lift.example.org") as server:
        assert server.client.get("/lifts").status_code == 200  # open until the first key
        scopes = {"alice": "read,write", "bob": "read,write", "reader": "read", "writer": "write"}
        secrets = {
            name: create_key(server, "--name", name, "--scopes", scope)["key"] for name, scope in scopes.items()
        }
        with httpx.Client(base_url=server.client.base_url, headers=bearer(secrets["alice"]), timeout=900) as alice:
            order = upload_scene(alice, tiny)
            first, second = (lift_of(alice, order)["id"] for _ in range(2))
        yield Keyed(server, secrets, order, (first, second))


def test_every_operation_wants_a_key(keyed: Keyed) -> None:
    for method, path, _ in keyed.operations():
        for headers in ({}, bearer("wrong"), bearer(keyed.secrets["alice"][:-1]), {"Authorization": "Basic YTpi"}):
            address = address_of(path, keyed.lifts[0], keyed.order["splats"])
            reply = keyed.ask(None, method, address, content=b"{", headers=headers)
            assert assert_problem(reply, 401)["type"] == "/problems/unauthorized", f"{method} {path}"
            assert reply.headers["www-authenticate"].startswith("Bearer")
    assert keyed.ask(None, "GET", "/nowhere").status_code == 401
    for path in OPEN:
        assert keyed.ask(None, "GET", path).status_code == 200, path


def test_every_operation_wants_its_scope(keyed: Keyed) -> None:
    refusals = {"reader": 0, "writer": 0}
    for method, path, _ in keyed.operations():
        if path in OWN_ROUTES:
            continue
        reads = method == "GET" or path.startswith(("/query", "/render"))
        other = "writer" if reads else "reader"
        reply = keyed.ask(other, method, address_of(path, keyed.lifts[0], keyed.order["splats"]), content=b"{")
        assert_problem(reply, 403)
        refusals[other] += 1
    assert min(refusals.values()) >= 10
    assert {entry["id"] for entry in keyed.ask("alice", "GET", "/lifts").json()["lifts"]} == set(keyed.lifts)


def named_requests(keyed: Keyed, lift: str, asset: str) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Yield method, template, path and options of a request to each operation that names a lift, job or asset."""
    values = {"lift": lift, "splats": asset, "cameras": asset, "features": [asset]}
    for method, path, description in keyed.operations():
        options = request_to(keyed.server.client, path, description, values)
        names = "{" in path or "lift" in options["params"] or {"lift", "splats"} & options.get("json", {}).keys()
        if names and method != "PUT":
            yield method, path, address_of(path, lift, asset), options


def test_what_is_anothers_is_absent(keyed: Keyed) -> None:
    own_items = list(named_requests(keyed, keyed.lifts[0], keyed.order["splats"]))
    absent = list(named_requests(keyed, NO_ID, NO_ASSET))
    assert len(own_items) == len(absent) >= 25
    for (method, path, address, options), (_, _, missing_places, no_items) in zip(own_items, absent, strict=True):
        reply = keyed.ask("bob", method, address, headers={"If-None-Match": "*"}, **options)
        other = keyed.ask("bob", method, missing_places, **no_items)
        for answer in (reply, other):
            assert_problem(answer, 404)
        texts = [IDS.sub("ID", json.dumps(answer.json() | {"request_id": None})) for answer in (reply, other)]
        assert texts[0] == texts[1], f"{method} {path}"  # it does not tell that it is there
    for path in ("/assets", "/jobs", "/lifts"):
        assert keyed.ask("bob", "GET", path).json()[path[1:]] == []
        assert keyed.ask("alice", "GET", path).json()[path[1:]] != []
    assert keyed.ask("alice", "GET", f"/lifts/{keyed.lifts[0]}").status_code == 200


def test_same_bytes_and_order_keys_are_of_each_who_sent_them(keyed: Keyed, tiny: TinyScene) -> None:
    key = {"Idempotency-Key": "the same"}
    first = keyed.ask("alice", "POST", "/lift", json=keyed.order, headers=key)
    assert first.status_code == 202
    assert keyed.ask("bob", "POST", "/lift", json=keyed.order, headers=key).status_code == 404
    reply = keyed.ask("bob", "PUT", "/assets/cameras", content=tiny.cameras)
    assert (reply.status_code, reply.json()["id"]) == (201, keyed.order["cameras"])  # that she has it is not told
    assert keyed.ask("bob", "PUT", "/assets/cameras", content=tiny.cameras).status_code == 200
    assert keyed.ask("bob", "DELETE", f"/assets/{keyed.order['cameras']}").status_code == 204
    content = keyed.ask("alice", "GET", f"/assets/{keyed.order['cameras']}/content").content
    assert content == tiny.cameras
    assert keyed.ask("bob", "POST", f"/jobs/{first.json()['id']}/cancel").status_code == 404
    job = f"/jobs/{first.json()['id']}"
    keyed.ask("alice", "POST", f"{job}/cancel")
    until(lambda: keyed.ask("alice", "GET", job).json()["state"] in ("canceled", "succeeded"))
    keyed.ask("alice", "DELETE", f"/lifts/{first.json()['id']}")


def test_share_reads_and_asks_its_lift_and_nothing_else(keyed: Keyed) -> None:
    shares = f"/lifts/{keyed.lifts[0]}/shares"
    reply = keyed.ask("alice", "POST", shares, json={"name": "a guest", "expires_s": 3600})
    share = reply.json()
    assert reply.status_code == 201 and share["expires"] == pytest.approx(time.time() + 3600, abs=600)
    guest = bearer(share["key"])
    own_items, other = (list(named_requests(keyed, lift, keyed.order["splats"])) for lift in keyed.lifts)
    allowed_statuses = 0
    for (method, path, address, options), (_, _, other_place, other_items) in zip(own_items, other, strict=True):
        reply, refused_replies = (
            keyed.server.client.request(method, at, headers=guest, **fields)
            for at, fields in ((address, options), (other_place, other_items))
        )
        assert refused_replies.status_code in (403, 404), f"{method} {path}"
        reads = method == "GET" or path.startswith(("/query", "/render"))
        if path.startswith(("/lifts", "/query", "/render")) and reads and "/shares" not in path:
            assert reply.status_code == keyed.ask("alice", method, address, **options).status_code, f"{method} {path}"
            allowed_statuses += reply.status_code == 200
        else:
            assert reply.status_code in (403, 404), f"{method} {path}"
    assert allowed_statuses >= 15
    assert [entry["id"] for entry in keyed.server.client.get("/lifts", headers=guest).json()["lifts"]] == [
        keyed.lifts[0]
    ]
    assert keyed.server.client.put("/assets/cameras", content=b"{}", headers=guest).status_code == 403
    listing = keyed.ask("alice", "GET", shares)
    assert [entry["id"] for entry in listing.json()["shares"]] == [share["id"]] and share["key"] not in listing.text
    assert keyed.ask("bob", "DELETE", share["links"]["self"]).status_code == 404
    assert keyed.server.client.get(f"/lifts/{keyed.lifts[0]}", headers=guest).status_code == 200
    assert keyed.ask("alice", "DELETE", share["links"]["self"]).status_code == 204
    assert_problem(keyed.server.client.get(f"/lifts/{keyed.lifts[0]}", headers=guest), 401)


@pytest.mark.parametrize(
    ("name", "fields", "status"),
    [
        (None, {"Host": "localhost.example.org"}, 421),
        (None, {"Origin": "null"}, 403),
        (None, {}, 401),
        ("reader", {}, 403),
        ("alice", {"Content-Length": str(1 << 50)}, 413),
    ],
    ids=str,
)
def test_head_is_refused_before_its_body_comes(
    keyed: Keyed, name: str | None, fields: dict[str, str], status: int
) -> None:
    key = {} if name is None else bearer(keyed.secrets[name])
    fields = {"Host": "localhost", "Content-Length": "1000"} | key | fields
    for head in ("PUT /assets/splats", "POST /lift", "POST /lift/plan", "POST /tradeoff"):
        lines = [f"{head} HTTP/1.1", *(f"{field}: {value}" for field, value in fields.items()), "", ""]
        address = keyed.server.client.base_url
        with socket.create_connection((address.host, address.port or 80), PATIENCE_SECONDS) as connection:
            connection.sendall("\r\n".join(lines).encode())
            assert connection.recv(100).split()[1] == str(status).encode(), head


def test_key_says_whose_it_is_and_what_it_may_at_the_host_of_the_settings(keyed: Keyed) -> None:
    own_items = keyed.ask("reader", "GET", "/key", headers={"Host": "lift.example.org"}).json()
    assert (own_items["name"], own_items["scopes"], own_items["expires"]) == ("reader", ["read"], None)


def test_keys_are_listed_without_secrets_and_end_at_once(keyed: Keyed) -> None:
    secret = create_key(keyed.server, "--name", "for a while", "--scopes", "read", "--expires", "12h")
    text = run_command("keys", "list", "--json", data=keyed.server.data)
    listing = {entry["name"]: entry for entry in json.loads(text)["keys"]}
    assert {"alice", "bob", "reader", "writer", "for a while"} <= listing.keys()
    assert listing["for a while"]["expires"] == pytest.approx(time.time() + 12 * 3600, abs=600)
    assert not any(value in text for value in (secret["key"], *keyed.secrets.values()))
    for path in keyed.server.data.rglob("*"):
        if path.is_file() and "sqlite" in path.name:
            assert secret["key"].encode() not in path.read_bytes()
    headers = bearer(secret["key"])
    assert keyed.server.client.get("/lifts", headers=headers).status_code == 200
    run_command("keys", "revoke", secret["id"], data=keyed.server.data)
    assert_problem(keyed.server.client.get("/lifts", headers=headers), 401)
    assert keyed.ask("reader", "GET", "/lifts").status_code == 200


def test_expired_key_is_let_in_no_more(keyed: Keyed) -> None:
    def create(expires: str) -> dict[str, Any] | None:
        """Make a key that is valid for so long; None where a busy machine comes to it too late."""
        key = create_key(keyed.server, "--name", "late", "--scopes", "read", "--expires", expires)
        return key if keyed.server.client.get("/lifts", headers=bearer(key["key"])).status_code == 200 else None

    key = create("5s") or create("2m")
    assert key is not None
    headers = bearer(key["key"])
    until(lambda: keyed.server.client.get("/lifts", headers=headers).status_code == 401, seconds=300)
    assert time.time() >= key["expires"] - 1


@pytest.mark.parametrize(
    "options",
    [
        ["create", "--name", "x", "--scopes", "everything"],
        ["create", "--name", "x", "--scopes", "read", "--expires", "2030-01-01"],
        ["revoke", "nobody"],
    ],
    ids=" ".join,
)
def test_bad_command_about_keys_is_one_line(keyed: Keyed, options: list[str]) -> None:
    line = run_command("keys", *options, data=keyed.server.data, status=2)
    assert "splatlift" in line and "Traceback" not in line


@pytest.mark.slow
def test_answers_are_as_the_document_says_and_what_is_deleted_is_gone(keyed: Keyed, tmp_path: Path) -> None:
    """Schemathesis calls each operation with one example; the same seed makes the same calls."""
    until(lambda: keyed.ask("alice", "GET", "/query", params={"text": "apple"}).status_code == 200)
    command = [
        str(Path(sys.executable).with_name("schemathesis")), "run",
        str(keyed.server.client.base_url.join("/openapi.json")),
        "--no-color", "--checks", ",".join(CHECKS), "--phases", "fuzzing,stateful", "--max-examples", "1",
        "--seed", "1", "--generation-deterministic", "--continue-on-failure", "--no-shrink",
        "--suppress-health-check", "all", "--warnings", "off", "--request-timeout", "300",
        "--header", f"Authorization: Bearer {keyed.secrets['alice']}",
    ]  # fmt: skip
    (tmp_path / "schemathesis.toml").write_text(REFUSALS)
    (tmp_path / "hooks.py").write_text(HOOKS)
    hooked = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(tmp_path)}
    process = subprocess.run(
        command, cwd=tmp_path, env=hooked, capture_output=True, text=True, timeout=CONTRACT_SECONDS, check=False
    )
    assert process.returncode == 0, f"{process.stdout}\n{process.stderr}"


def test_service_stays_closed_when_its_last_key_is_revoked(keyed: Keyed) -> None:
    for entry in json.loads(run_command("keys", "list", "--json", data=keyed.server.data))["keys"]:
        if entry["revoked"] is None:
            run_command("keys", "revoke", entry["id"], data=keyed.server.data)
    for name in (None, *keyed.secrets):
        assert_problem(keyed.ask(name, "GET", "/lifts"), 401)
