"""Whatever is sent to whatever route: a refusal has the one shape, the right status, and is never our fault.

The routes come from the application itself, so a new one is held to this too.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from service.store.jobs import JobOrder
from service.store.owners import SERVICE
from tests.crash.conftest import until

from .conftest import SceneAssets, parts_of
from .test_problems import NO_ASSET, UNKNOWN_ID, assert_problem
from .test_slow_clients import answer, client_of, serve

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "BREW")
ODD_PARTS = ("%00", "%FF%FE", "%ED%A0%80", "..%2F..%2Fetc%2Fpasswd", "a" * 6000, "%0d%0aX:y", "-1")
ODD_VALUES = ("", "%00", "%ED%A0%80", "nan", "-1", "1e999", "9" * 5000, "%0d%0aX:y")
ODD_HEADERS = (
    {"Idempotency-Key": b"\xe4"}, {"Last-Event-ID": b"x"}, {"Last-Event-ID": b"9" * 5000}, {"Content-Type": b"\xff"},
    {"Content-Encoding": b"\xff"}, {"Range": b"bytes=" + b"9" * 5000 + b"-"}, {"If-None-Match": b"\xff"},
    {"If-Range": b'"'}, {"Authorization": b"\xff"}, {"Cookie": b"=;\xff"}, {"Expect": b"magic"},
    {"Transfer-Encoding": b"gzip"},
)  # fmt: skip
ODD_BODIES = (
    b"", b"{", b"[]", b"null", b"\xff\xfe", b'"\xed\xa0\x80"', b"[" * 60_000, b'{"text": NaN}', b'{"\\ud800": 1}',
    b"1" * 5000, b'{"text": [1], "text": {}}', b"\xef\xbb\xbf{}", b'{"like": [[]]}', b'{"like": [[1e999]]}',
    b'{"like": [null]}', b'{"like": [{"a": 1}]}', b'{"like": ["\\ud800:1,1"]}', b'{"text": ["\\ud800"]}',
    b'{"like": [[1' + b"0" * 400 + b"]]}", b'{"settings": {"power": 1' + b"0" * 5000 + b"}}",
)  # fmt: skip

ODD_MEDIA = ("multipart/form-data; boundary=x", "nonsense", "application/json; charset=utf-7")


@pytest.fixture(scope="module")
def routes(client: TestClient) -> dict[str, set[str]]:
    """Return the methods of each path template of the application."""
    assert isinstance(client.app, FastAPI)
    methods_by_path: dict[str, set[str]] = {}
    for context in iter_route_contexts(client.app.routes):
        if context.path is not None:
            methods_by_path.setdefault(context.path, set()).update(context.methods or ())
    assert {"/", "/metrics", "/lift", "/openapi.json", "/assets/{asset}"} <= methods_by_path.keys()
    return {path: methods | {"HEAD"} if "GET" in methods else methods for path, methods in methods_by_path.items()}


def address(path: str, part: str | None = None) -> str:
    """A path of a template: of nothing that exists, or with an odd part."""
    address_text = path.replace("{asset}", part or NO_ASSET)
    return re.sub(r"\{\w+\}", part or UNKNOWN_ID, address_text)


def assert_refused(reply: Any, method: str) -> str:
    """The type of a problem; answers to HEAD have no body to tell it."""
    if method != "HEAD":
        return assert_problem(reply)["type"]
    assert reply.headers["content-type"] == "application/problem+json" and not reply.content
    return "(no body)"


def test_every_route_answers_405_to_what_it_does_not_take(client: TestClient, routes: dict[str, set[str]]) -> None:
    for path, methods in routes.items():
        for method in set(METHODS) - methods:
            reply = client.request(method, address(path))
            assert reply.status_code == 405, (method, path)
            assert set(reply.headers["allow"].split(", ")) == methods
            assert assert_refused(reply, method) in ("/problems/method-not-allowed", "(no body)")
            if method != "HEAD":
                assert reply.json()["expected"] == f"one of {reply.headers['allow']}"
                assert reply.json()["detail"].endswith(f"expected one of {reply.headers['allow']}, got {method}")


@pytest.mark.parametrize(
    "path", ["/nowhere", "/jobs/a/b/c", "//", "/%2e%2e/", "/Healthz", "/healthz/", "/%00", "/%FF"]
)
def test_unknown_paths_are_404_for_every_method(client: TestClient, path: str) -> None:
    for method in METHODS:
        reply = client.request(method, f"http://127.0.0.1{path}")
        assert reply.status_code == 404, (method, reply.status_code, reply.headers)
        assert assert_refused(reply, method) in ("/problems/no-such-route", "(no body)")
        assert len(reply.content) < 1000


def odd_requests(client: TestClient, path: str, methods: set[str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Method, address and more of what no route of this path expects."""
    for method, part in itertools.product(methods, ODD_PARTS if "{" in path else ()):
        yield method, address(path, part), {}
    operations = client.get("/openapi.json").json()["paths"].get(path, {}).values()
    problem = [parameter for operation in operations for parameter in operation.get("parameters", ())]
    names = {parameter["name"] for parameter in problem if parameter["in"] == "query"}
    for method, name, value in itertools.product(methods, names, ODD_VALUES):
        required = "".join(f"&{other}=left" for other in names & {"text", "view"} - {name})
        yield method, f"{address(path)}?{name}={value}{required}", {}
    for odd in ODD_HEADERS:  # one method is enough, as what reads headers knows none
        yield min(methods), address(path), {"headers": {name.encode(): value for name, value in odd.items()}}
    bodies = itertools.chain(
        itertools.product(ODD_BODIES, ["application/json"]), itertools.product(ODD_BODIES[:4], ODD_MEDIA)
    )
    for body, media in bodies if "POST" in methods else ():
        yield "POST", address(path), {"content": body, "headers": {"Content-Type": media}}


def test_odd_requests_are_refused_as_problems_or_taken(
    client: TestClient, routes: dict[str, set[str]], lift: Any
) -> None:
    for path, methods in routes.items():
        for method, route, options in odd_requests(client, path, methods - {"HEAD"}):
            reply = client.request(method, route, **options)
            assert reply.status_code < 500, (method, route, options, reply.text)
            if reply.status_code >= 400:
                assert_problem(reply)
            elif "content" in options:  # queries of many words have defaults for all fields
                by_default = path.startswith(("/query/segment", "/query/export"))
                assert options["content"].endswith(b"{}") and by_default, (path, options)


def test_body_that_is_no_object_is_named_so(client: TestClient, lift: dict[str, Any]) -> None:
    selection = client.post(f"/lifts/{lift['id']}/selections", json={"name": "mine"}).json()["links"]["self"]
    for path, operations in client.get("/openapi.json").json()["paths"].items():
        route = re.sub(r"/lifts/{lift}/selections/{selection}", selection, path).replace("{lift}", lift["id"])
        for method, operation in operations.items():
            if "application/json" in operation.get("requestBody", {}).get("content", {}):
                for body in (b"3", b"[]", b'"text"', b"null"):
                    media = {"Content-Type": "application/json"}
                    reply = client.request(method, address(route), content=body, headers=media)
                    problem = assert_problem(reply)
                    assert (problem["status"], problem["argument"]) == (422, "body"), (method, path, body, problem)
    assert client.delete(selection).status_code == 204


def test_long_bodies_are_413_where_bodies_are_read(client: TestClient, routes: dict[str, set[str]]) -> None:
    for path, methods in routes.items():
        if "POST" in methods and "{" not in path and path != "/assets":  # which takes a file
            reply = client.post(path, content=b" " * 2_000_000, headers={"Content-Type": "application/json"})
            assert assert_problem(reply)["status"] == 413, path


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    """A server behind a socket."""
    with serve(tmp_path_factory.mktemp("live") / "data") as host_and_port:
        yield host_and_port


HOST = b"Host: 127.0.0.1\r\n"
NO_HTTP = {
    "no HTTP": b"GARBAGE\r\n\r\n",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(64),
    "raw bytes in the path": b"GET /\xff\xfe HTTP/1.1\r\n" + HOST + b"\r\n",
    "NUL in the path": b"GET /\x00 HTTP/1.1\r\n" + HOST + b"\r\n",
    "NUL in a header": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: a\x00b\r\n\r\n",
    "space in a header's name": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X y: z\r\n\r\n",
    "no Host": b"GET /healthz HTTP/1.1\r\n\r\n",
    "two Hosts": b"GET /healthz HTTP/1.1\r\n" + HOST + HOST + b"\r\n",
    "an overlong path": b"GET /" + b"a" * 100_000,
    "an overlong header": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: " + b"a" * 100_000,
    "two lengths": b"POST /lift HTTP/1.1\r\n" + HOST + b"Content-Length: 1\r\nContent-Length: 2\r\n\r\nab",
    "a negative length": b"POST /lift HTTP/1.1\r\n" + HOST + b"Content-Length: -1\r\n\r\n",
    "an unknown transfer": b"POST /lift HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: magic\r\n\r\n",
    "a bad chunk": (
        b"POST /lift HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"
        b"Transfer-Encoding: chunked\r\n\r\nzz\r\n"
    ),
}
ODD_HTTP = {
    "a proxy's request": (b"GET http://example.org/ HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n", 404),
    "OPTIONS *": (b"OPTIONS * HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n", 404),
    "CONNECT": (b"CONNECT example.org:443 HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n", 404),
    "a lower-case method": (b"get /healthz HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n", 405),
    "a foreign Host": (b"GET /healthz HTTP/1.1\r\nHost: example.org\r\nConnection: close\r\n\r\n", 421),
    "a WebSocket": (
        b"GET /nowhere HTTP/1.1\r\n" + HOST + b"Connection: upgrade, close\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        404,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_HTTP)
def test_what_is_no_http_is_400_and_the_connection_is_closed(live: tuple[str, int], name: str) -> None:
    with client_of(live) as connection:
        with contextlib.suppress(ConnectionError):  # the server may have heard enough before all was sent
            connection.sendall(NO_HTTP[name])
        head, body = answer(connection)
    assert head.startswith(b"HTTP/1.1 400 "), head
    assert b"connection: close" in head.lower() and b"Traceback" not in body


@pytest.mark.parametrize("name", ODD_HTTP)
def test_odd_requests_are_problems_too(live: tuple[str, int], name: str) -> None:
    request_bytes, status = ODD_HTTP[name]
    with client_of(live) as connection:
        with contextlib.suppress(ConnectionError):  # the server may have heard enough before all was sent
            connection.sendall(request_bytes)
        head, body = (part.decode() for part in answer(connection))
    assert head.startswith(f"HTTP/1.1 {status} "), head
    assert "content-type: application/problem+json" in head.lower()
    problem = json.loads(body)
    assert problem["status"] == status and problem["title"] and problem["detail"]
    assert problem["type"].startswith("/problems/")
    assert f"x-request-id: {problem['request_id']}" in head.lower()


# HEAD is answered wherever GET is, with the head of that answer and nothing after it


def test_head_is_the_head_of_get(client: TestClient, lift: dict[str, Any], scene_assets: SceneAssets) -> None:
    lift_path, route = f"/lifts/{lift['id']}", f"text=apple&lift={lift['id']}"
    content = f"/assets/{scene_assets.splats}/content"
    paths = [
        "/healthz", "/readyz", "/version", "/metrics", "/", "/openapi.json", "/docs", "/assets", content,
        f"/assets/{scene_assets.splats}", "/jobs", f"/jobs/{lift['id']}", f"/jobs/{lift['id']}/events", "/lifts",
        lift_path,
        f"{lift_path}/features", f"/query?{route}", f"/query/objects?{route}", f"/query/scores?{route}",
        f"/query/mask?{route}&view=left", f"{lift_path}/objects/0/splats", f"/render?lift={lift['id']}&view=left",
    ]  # fmt: skip
    for path in (*paths, f"/lifts/{UNKNOWN_ID}", "/query?text=", "/nowhere"):
        full, head = client.get(path), client.head(path)
        assert (head.status_code, head.content) == (full.status_code, b""), path
        assert (head.status_code == 200) is (path in paths), path
        names = (set(full.headers) | set(head.headers)) - {"x-request-id"}
        if path == "/metrics" or head.status_code >= 400:  # counts come to have more digits, and ids are other ones
            names -= {"content-length"}
        assert all(head.headers.get(name) == full.headers.get(name) for name in names), path
    full = client.head(content, headers={"Range": "bytes=0-3"})  # ranges are for GET alone
    assert (full.status_code, int(full.headers["content-length"])) == (200, len(client.get(content).content))
    assert client.head(content, headers={"If-None-Match": full.headers["etag"]}).status_code == 304
    head_of_lift = client.head("/lift")
    assert (head_of_lift.status_code, head_of_lift.headers["allow"]) == (405, "POST")


def test_connection_goes_on_after_a_head(live: tuple[str, int]) -> None:
    for path in ("/healthz", "/", "/lifts/nothing"):
        with client_of(live) as connection:
            line = f"{path} HTTP/1.1\r\nHost: localhost\r\n"
            connection.sendall(f"HEAD {line}\r\nHEAD {line}Connection: close\r\n\r\n".encode())
            problem = b"\r\n\r\n".join(answer(connection))
        assert problem.count(b"HTTP/1.1 ") == problem.count(b"\r\n\r\n") == 2 and problem.endswith(b"\r\n\r\n")


def test_head_of_events_ends_at_once_and_leaves_no_stream(client: TestClient, scene_assets: SceneAssets) -> None:
    parts = parts_of(client)
    order = JobOrder(
        splats=scene_assets.splats, cameras=scene_assets.cameras, features=(scene_assets.features,), settings={}
    )
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
