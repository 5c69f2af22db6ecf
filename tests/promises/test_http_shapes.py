"""Whatever is sent to whatever operation: a refusal has the one shape, and is never the service's fault.

The operations are those of the OpenAPI document, so a new one is held to this too.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.server import PATIENCE_SECONDS, Server

from .over_http import NO_ASSET, NO_ID, address_of, assert_problem, operations_of, request_to

ODD_PARTS = ("%00", "%FF%FE", "..%2F..%2Fetc%2Fpasswd", "a" * 3000, "%0d%0aX:y", "-1", " ")
ODD_VALUES = ("", "%00", "%FF", "nan", "-1", "1e999", "9" * 3000, "%0d%0aX:y")
ODD_BODIES = (
    b"", b"{", b"[]", b"null", b"\xff\xfe", b'"\xed\xa0\x80"', b"[" * 60_000, b'{"text": NaN}', b'{"\\ud800": 1}',
    b"1" * 5000, b'{"like": [[1e999]]}', b'{"like": [{"a": 1}], "settings": [1]}',
    b'{"text": ["\\ud800"], "name": "\\ud800"}', b'{"settings": {"power": 1' + b"0" * 5000 + b"}}",
    b'{"lift": 1, "splats": {}, "features": [null]}',
)  # fmt: skip
ODD_HEADERS: tuple[dict[str, bytes], ...] = (
    {"Idempotency-Key": b"\xe4"}, {"Last-Event-ID": b"x"}, {"Last-Event-ID": b"9" * 5000}, {"Content-Type": b"\xff"},
    {"Content-Encoding": b"gzip"}, {"Range": b"bytes=" + b"9" * 5000 + b"-"}, {"If-None-Match": b"\xff"},
    {"If-Match": b'"'}, {"If-Range": b'"'}, {"Authorization": b"\xff"}, {"Cookie": b"=;\xff"},
)  # fmt: skip
JSON = {"Content-Type": "application/json"}
Operations = list[tuple[str, str, dict[str, Any]]]


@pytest.fixture(scope="module")
def fast(server: Server) -> Iterator[httpx.Client]:
    """A client that keeps its connections."""
    with httpx.Client(base_url=server.client.base_url, timeout=PATIENCE_SECONDS) as client:
        yield client


@pytest.fixture(scope="module")
def operations(fast: httpx.Client) -> Operations:
    return operations_of(fast)


def require_no_fault(reply: httpx.Response, *request: object) -> None:
    """Require an answer that is none of the service's faults, and a problem if it is a refusal."""
    assert reply.status_code < 500, (*request, reply.text)
    if reply.status_code >= 400:
        problem = assert_problem(reply)
        assert problem["request_id"] == reply.headers["x-request-id"]


def test_odd_parts_of_paths_are_refused(fast: httpx.Client, operations: Operations) -> None:
    for method, path, _ in operations:
        if re.search(r"\{(job|lift|tradeoff|asset)\}", path):  # which take an odd part
            for part in ODD_PARTS:
                address = address_of(path, part, part)
                reply = fast.request(method, address, json=None if method == "GET" else {})
                require_no_fault(reply, method, address)
                assert reply.status_code in (404, 405, 415, 422) or method == "PUT", (method, address)


def test_odd_parameters_are_refused_or_ignored(
    fast: httpx.Client, operations: Operations, lift: dict[str, Any]
) -> None:
    for method, path, description in operations:
        names = [entry["name"] for entry in description.get("parameters", ()) if entry["in"] == "query"]
        if method == "GET":
            address = address_of(path, lift["id"], lift["splats"])
            for name in [*names, "unknown"]:
                for value in ODD_VALUES:
                    require_no_fault(fast.get(f"{address}?{name}={value}"), address, name, value[:20])


def test_odd_bodies_are_refused(fast: httpx.Client, operations: Operations, lift: dict[str, Any]) -> None:
    before = fast.get(lift["links"]["self"]).json()
    for method, path, description in operations:
        if "application/json" in description.get("requestBody", {}).get("content", {}):
            address = address_of(path, lift["id"], lift["splats"])
            for body in ODD_BODIES:
                reply = fast.request(method, address, content=body, headers=JSON)
                require_no_fault(reply, method, address, body[:40])
                assert reply.status_code >= 400, (method, address, body[:40])
            for media_type in ("text/plain", "multipart/form-data; boundary=x", "nonsense"):
                reply = fast.request(method, address, content=b"--x--", headers={"Content-Type": media_type})
                require_no_fault(reply, method, address, media_type)
                assert reply.status_code >= 400, (method, address, media_type)
    assert fast.get(lift["links"]["self"]).json() == before


def test_fields_of_wrong_types_are_named(fast: httpx.Client, operations: Operations, lift: dict[str, Any]) -> None:
    values = {"lift": lift["id"], "splats": lift["splats"], "cameras": lift["cameras"], "features": lift["features"]}
    for method, path, description in operations:
        fields = request_to(fast, path, description, values).get("json", {})
        for name in fields:
            for wrong in ({"a": 1}, [[{}]], -1e300, True):
                address = address_of(path, lift["id"], lift["splats"])
                reply = fast.request(method, address, content=json.dumps(fields | {name: wrong}), headers=JSON)
                require_no_fault(reply, method, address, name, wrong)
                assert reply.status_code in (404, 422), (method, address, name, wrong)
                if reply.status_code == 422:
                    assert reply.json()["argument"] and reply.json()["expected"], (method, address, name)


@pytest.mark.parametrize("headers", ODD_HEADERS, ids=str)
def test_odd_headers_harm_nothing(
    fast: httpx.Client, operations: Operations, lift: dict[str, Any], headers: dict[str, bytes]
) -> None:
    for method, path, _ in operations:
        if method in ("GET", "POST") and "/events" not in path:
            options: dict[str, Any] = {} if method == "GET" else {"content": b"{}"}
            address = address_of(path, NO_ID if method == "POST" else lift["id"], NO_ASSET)
            encoded = {b"Content-Type": b"application/json"} | {name.encode(): text for name, text in headers.items()}
            reply = fast.request(method, address, headers=encoded, **options)
            require_no_fault(reply, method, address, headers)


def test_other_methods_are_405_and_other_paths_404(fast: httpx.Client, operations: Operations) -> None:
    methods: dict[str, set[str]] = {}
    for method, path, _ in operations:
        methods.setdefault(path, set()).add(method)
    for path, allowed_statuses in methods.items():
        for method in {"GET", "POST", "PUT", "PATCH", "DELETE", "BREW"} - allowed_statuses:
            reply = fast.request(method, address_of(path, NO_ID, NO_ASSET))
            if path.startswith("/assets/{") and path.count("/") == 2:
                require_no_fault(reply, method, path)  # PUT takes a kind where the others take an id
            else:
                assert_problem(reply, 405)
                assert allowed_statuses <= set(reply.headers["allow"].split(", ")), (method, path)
    for path in ("/nowhere", "/jobs/a/b/c", "/Healthz", "/%00", "/query/nothing", "/.env", "/web/../../etc/passwd"):
        assert_problem(fast.get(path), 404)
