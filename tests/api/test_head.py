"""HEAD is answered wherever GET is, with the head of that answer and nothing after it."""

from __future__ import annotations

import socket
from typing import Any

import httpx
from fastapi.testclient import TestClient

from service.store.jobs import JobOrder
from service.store.owners import SERVICE
from tests.crash.conftest import address_of, until

from .conftest import Uploaded, parts_of
from .test_problems import NOBODY
from .test_slow_clients import PATIENCE_SECONDS, running


def addresses(lift: dict[str, Any], uploaded: Uploaded) -> list[str]:
    """One of each route that answers GET with something."""
    own = f"/lifts/{lift['id']}"
    asked = f"text=apple&lift={lift['id']}"
    return [
        "/healthz", "/readyz", "/version", "/metrics", "/", "/openapi.json", "/docs",
        "/assets", f"/assets/{uploaded.splats}", f"/assets/{uploaded.splats}/content",
        "/jobs", f"/jobs/{lift['id']}", f"/jobs/{lift['id']}/events", "/lifts", own, f"{own}/features",
        f"/query?{asked}", f"/query/objects?{asked}", f"/query/scores?{asked}",
        f"/query/mask?{asked}&view=left",
        f"{own}/objects", f"{own}/objects/0/splats", f"/render?lift={lift['id']}&view=left",
    ]  # fmt: skip


def test_head_is_the_head_of_get(client: TestClient, lift: dict[str, Any], uploaded: Uploaded) -> None:
    for address in addresses(lift, uploaded):
        whole, head = client.get(address), client.head(address)
        assert (head.status_code, head.content) == (200, b""), address
        names = (set(whole.headers) | set(head.headers)) - {"x-request-id"}
        if address == "/metrics":  # whose counts come to have more digits
            names -= {"content-length"}
        assert all(head.headers.get(name) == whole.headers.get(name) for name in names), address
    path = f"/assets/{uploaded.splats}/content"
    part = client.head(path, headers={"Range": "bytes=0-3"})
    assert (part.status_code, part.headers["content-length"], part.content) == (206, "4", b"")
    assert client.head(path, headers={"If-None-Match": part.headers["etag"]}).status_code == 304


def test_head_of_what_is_not_there_is_as_of_get(client: TestClient) -> None:
    for address in (f"/lifts/{NOBODY}", "/query?text=", "/nowhere"):
        whole, head = client.get(address), client.head(address)
        assert (head.status_code, head.content) == (whole.status_code, b"")
        assert head.headers["content-type"] == "application/problem+json"
    refused = client.head("/lift")
    assert (refused.status_code, refused.headers["allow"]) == (405, "POST")


def test_head_of_events_ends_at_once_and_leaves_no_stream(client: TestClient, uploaded: Uploaded) -> None:
    parts = parts_of(client)
    order = JobOrder(splats=uploaded.splats, cameras=uploaded.cameras, features=(uploaded.features,), settings={})
    job, _ = parts.store.jobs.submit(SERVICE, order, max_queued=10)  # nobody is woken for it, so it stays in line
    try:
        for _ in range(3):
            head = client.head(f"/jobs/{job}/events")
            assert (head.status_code, head.content) == (200, b"")
            assert head.headers["content-type"].startswith("text/event-stream")
        assert parts.streams.open == 0
    finally:
        client.post(f"/jobs/{job}/cancel")
        until(lambda: client.delete(f"/jobs/{job}").status_code == 204)


def test_connection_goes_on_after_a_head(tmp_path: Any) -> None:
    with running(tmp_path / "data") as server:
        host, port = address_of(server)
        for address in ("/healthz", "/", "/lifts/nothing"):
            with httpx.Client(base_url=f"http://{host}:{port}", timeout=PATIENCE_SECONDS) as client:
                head, whole = client.head(address), client.get(address)
                assert head.status_code == whole.status_code and head.content == b"" and whole.content
                until(lambda: len(server.server_state.connections) == 1)
            with socket.create_connection((host, port), timeout=PATIENCE_SECONDS) as raw:
                raw.sendall(f"HEAD {address} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
                told = b"".join(iter(lambda: raw.recv(4096), b""))
            assert told.endswith(b"\r\n\r\n") and told.count(b"\r\n\r\n") == 1
