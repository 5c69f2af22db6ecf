"""Every error has the one shape of RFC 9457, on every route."""

from __future__ import annotations

import errno
import json
import math
import re
import sqlite3
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from liftcore.errors import SplatliftError
from service import problems
from service.child import error_of, fault_of
from service.problems import TABLE, problem_of

from .conftest import Uploaded

ROUTES = {
    "/healthz",
    "/readyz",
    "/version",
    "/metrics",
    "/assets",
    "/assets/{asset}",
    "/assets/{asset}/content",
    "/assets/{asset}/names",
    "/lift",
    "/lift/plan",
    "/jobs",
    "/jobs/{job}",
    "/jobs/{job}/events",
    "/jobs/{job}/cancel",
    "/tradeoff",
    "/tradeoffs/{tradeoff}",
    "/tradeoffs/{tradeoff}/chart",
    "/tradeoffs/{tradeoff}/table",
    "/lifts",
    "/lifts/{lift}",
    "/lifts/{lift}/features",
    "/lifts/{lift}/splats",
    "/lifts/{lift}/colours",
    "/lifts/{lift}/photo",
    "/lifts/{lift}/views",
    "/lifts/{lift}/regions",
    "/lifts/{lift}/regions/mask",
    "/lifts/{lift}/objects",
    "/lifts/{lift}/objects/{thing}/splats",
    "/query",
    "/query/objects",
    "/query/scores",
    "/query/mask",
    "/query/attention",
    "/query/splats",
    "/query/segment",
    "/query/segment/labels",
    "/query/segment/map",
    "/query/segment/picture",
    "/query/what",
    "/render",
}
NOBODY = "0" * 32
NO_ASSET = "sha256:" + "0" * 64


def assert_problem(reply: Any) -> dict[str, Any]:
    """The reply is a problem; its body."""
    assert reply.headers["content-type"] == "application/problem+json", reply.text
    body = reply.json()
    assert body["status"] == reply.status_code >= 400
    assert re.fullmatch(r"/problems/[a-z]+(-[a-z]+)*", body["type"])
    assert body["title"] and body["detail"] and "\n" not in body["detail"]
    return body


def every_route(client: TestClient) -> list[tuple[str, str]]:
    """Method and path of every documented route."""
    paths = client.get("/openapi.json").json()["paths"]
    return [(method.upper(), path) for path, methods in paths.items() for method in methods]


@pytest.mark.parametrize(
    "path",
    [f"/jobs/{NOBODY}", f"/lifts/{NOBODY}", f"/lifts/{NOBODY}/features", f"/assets/{NO_ASSET}/content"],
)
def test_unknown_thing_is_404(client: TestClient, path: str) -> None:
    assert assert_problem(client.get(path))["type"] == "/problems/not-found"


@pytest.mark.parametrize(
    ("change", "status", "kind"),
    [
        ({"settings": {"preset": "magic"}}, 422, "invalid-settings"),
        ({"settings": {"power": 3}}, 422, "invalid-settings"),
        ({"settings": {"prest": "row-sum"}}, 422, "invalid-settings"),
        ({"settings": {"cls": 1}}, 422, "invalid-settings"),
        ({"settings": {"self": 1}}, 422, "invalid-settings"),
        ({"settings": {"preset": ["row-sum"]}}, 422, "invalid-request"),
        ({"settings": {"alpha_cap": math.inf}}, 422, "invalid-settings"),
        ({"settings": {"lift_gain": math.nan}}, 422, "invalid-settings"),
        ({"splats": NO_ASSET}, 404, "not-found"),
        ({"features": [NO_ASSET]}, 404, "not-found"),
        ({"features": []}, 422, "invalid-request"),
        ({"cameras": "sha256:short"}, 422, "invalid-request"),
        ({"extra": 1}, 422, "invalid-request"),
    ],
)
def test_bad_order_is_refused_before_it_is_a_job(
    client: TestClient, uploaded: Uploaded, change: dict[str, Any], status: int, kind: str
) -> None:
    before = len(client.get("/jobs").json()["jobs"])
    content = json.dumps(uploaded.order() | change)
    reply = client.post("/lift", content=content, headers={"Content-Type": "application/json"})
    body = assert_problem(reply)
    assert (body["status"], body["type"]) == (status, f"/problems/{kind}")
    assert len(client.get("/jobs").json()["jobs"]) == before


def test_assets_in_the_wrong_place_are_refused(client: TestClient, uploaded: Uploaded) -> None:
    body = assert_problem(client.post("/lift", json=uploaded.order() | {"splats": uploaded.cameras}))
    assert body["status"] == 404 and "cameras" in body["got"]


def test_one_pack_twice_is_refused(client: TestClient, uploaded: Uploaded) -> None:
    twice = uploaded.order() | {"features": [uploaded.features, uploaded.features]}
    assert assert_problem(client.post("/lift", json=twice))["type"] == "/problems/invalid-features"


@pytest.mark.parametrize(
    ("path", "change", "status", "kind"),
    [
        ("/query", {"text": ""}, 422, "invalid-request"),
        ("/query", {"text": "   "}, 422, "invalid-query"),
        ("/query", {"text": "zeppelin"}, 422, "invalid-query"),
        ("/query", {"lift": NOBODY}, 404, "not-found"),
        ("/query", {"view": "behind"}, 404, "not-found"),
        ("/query", {"threshold": "high"}, 422, "invalid-request"),
        ("/query", {"threshold": "nan"}, 422, "invalid-request"),
        ("/query", {"top": "-1"}, 422, "invalid-request"),
        ("/query", {"negatives": "zeppelin"}, 422, "invalid-query"),
        ("/query", {"encoder": "table:/etc/passwd"}, 422, "invalid-request"),
        ("/query", {"encoder": "spare"}, 422, "invalid-query"),  # 5 channels and not 8
        ("/query/mask", {"view": "behind"}, 404, "not-found"),
        ("/query/mask", {}, 422, "invalid-request"),
        ("/query/objects", {"threshold": "high"}, 422, "invalid-request"),
        ("/query/objects", {"text": "zeppelin"}, 422, "invalid-query"),
        ("/query/scores", {"lift": "../../etc/passwd"}, 422, "invalid-request"),
        # Nothing is found, so there is no object.
        ("/query/splats", {"negatives": "book", "threshold": "1"}, 422, "invalid-query"),
        ("/query/splats", {"what": "mesh"}, 422, "invalid-request"),
        ("/render", {"view": "behind"}, 404, "not-found"),
        ("/render", {"view": "left", "what": "x-rays"}, 422, "invalid-request"),
    ],
)
def test_bad_query_is_a_problem(
    client: TestClient, lift: dict[str, Any], path: str, change: dict[str, str], status: int, kind: str
) -> None:
    asked = {"lift": lift["id"]} if path == "/render" else {"text": "apple", "lift": lift["id"]}
    reply = client.get(path, params=asked | change)
    body = assert_problem(reply)
    assert (body["status"], body["type"]) == (status, f"/problems/{kind}"), body


def test_unexpected_error_says_nothing_of_itself() -> None:
    app = FastAPI()
    problems.install(app)

    @app.get("/broken")
    def broken() -> None:
        raise RuntimeError("the secret")

    reply = TestClient(app, raise_server_exceptions=False).get("/broken")
    assert assert_problem(reply)["type"] == "/problems/internal"
    assert "secret" not in reply.text


@pytest.mark.parametrize(
    "body",
    [
        b'{"\\ud800": 1}',
        b'{"settings": {"\\ud800": 1}}',
        b'{"settings": {"a\\nb": 1}}',
        b'{"settings": {"preset": "\\ud800"}}',
        b'{"settings": {"power": 1' + b"0" * 5000 + b"}}",
        b"[" * 100_000,
        b"\xff\xfe",
    ],
)
def test_no_body_makes_it_our_fault(client: TestClient, uploaded: Uploaded, body: bytes) -> None:
    if body.startswith(b'{"settings'):  # the rest of the order is right, so that the settings are read
        body = (
            json.dumps({name: value for name, value in uploaded.order().items() if name != "settings"}).encode()[:-1]
            + b", "
            + body[1:]
        )
    reply = client.post("/lift", content=body, headers={"Content-Type": "application/json"})
    assert 400 <= assert_problem(reply)["status"] < 500


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), sqlite3.OperationalError("disk is full")])
def test_full_disk_is_507(error: Exception) -> None:
    if isinstance(error, sqlite3.OperationalError):
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
    app = FastAPI()
    problems.install(app)

    @app.get("/")
    def full() -> None:
        raise error

    reply = TestClient(app, raise_server_exceptions=False).get("/")
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/no-space", 507)


def test_every_error_has_a_row_and_crosses_processes() -> None:
    for cls in TABLE:
        error = cls("place", expected="this", got="that at /data/blobs/x", hint="try")
        back = error_of(fault_of(error, {"/data/blobs/x": "splats y"}))
        assert type(back) is cls and back.got == "that at splats y"
        assert problem_of(back).type == f"/problems/{cls.kind}"
    kinds = [cls.kind for cls in TABLE]
    assert len(set(kinds)) == len(kinds)
    assert issubclass(next(iter(TABLE)), SplatliftError)


def test_openapi_names_the_problem_and_the_routes(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    assert "Problem" in document["components"]["schemas"]
    assert "HTTPValidationError" not in document["components"]["schemas"]
    assert set(document["paths"]) == ROUTES
