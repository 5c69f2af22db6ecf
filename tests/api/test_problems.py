"""Every error has the one shape of RFC 9457, on every route."""

from __future__ import annotations

import errno
import gzip
import re
import sqlite3
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from liftcore.errors import SplatliftError
from service import errors, problems
from service.child import error_of, fault_of
from service.problems import TABLE, problem_of

UNKNOWN_ID = "0" * 32
NO_ASSET = "sha256:" + "0" * 64


def assert_problem(reply: Any) -> dict[str, Any]:
    """The reply is a problem; its body."""
    assert reply.headers["content-type"] == "application/problem+json", reply.text
    body = reply.json()
    assert body["status"] == reply.status_code >= 400
    assert re.fullmatch(r"/problems/[a-z]+(-[a-z]+)*", body["type"])
    assert body["title"] and body["detail"] and "\n" not in body["detail"]
    return body


FULL = sqlite3.OperationalError("disk is full")
FULL.sqlite_errorcode = sqlite3.SQLITE_FULL


@pytest.mark.parametrize(
    ("error", "status", "kind"),
    [
        (RuntimeError("the secret"), 500, "internal"),
        (OSError(errno.ENOSPC, "the secret"), 507, "no-space"),
        (OSError(errno.EMFILE, "the secret"), 503, "busy"),
        (FULL, 507, "no-space"),
    ],
)
def test_error_that_nobody_foresaw_says_nothing_of_itself(error: Exception, status: int, kind: str) -> None:
    app = FastAPI()
    problems.install(app)

    @app.get("/broken")
    def broken() -> None:
        raise error

    reply = TestClient(app, raise_server_exceptions=False).get("/broken")
    assert (reply.status_code, assert_problem(reply)["type"]) == (status, f"/problems/{kind}")
    assert "secret" not in reply.text


def test_every_error_has_a_row_and_crosses_processes() -> None:
    classes = [*TABLE, *(cls for cls in vars(errors).values() if isinstance(cls, type) and "status" in vars(cls))]
    for cls in classes:
        error = cls("place", expected="this", got="that at /data/blobs/x", hint="try")
        back = error_of(fault_of(error, {"/data/blobs/x": "splats y"}))
        assert type(back) is cls and back.got == "that at splats y"
        assert problem_of(back).type == f"/problems/{cls.kind}"
    kinds = [cls.kind for cls in classes]
    assert len(set(kinds)) == len(kinds)
    assert issubclass(next(iter(TABLE)), SplatliftError)


JSON = {"Content-Type": "application/json"}


def test_bodies_of_json_come_plain_and_bounded(client: TestClient) -> None:
    problem = assert_problem(
        client.post("/lift", content=gzip.compress(b"{}"), headers=JSON | {"Content-Encoding": "gzip"})
    )
    assert (problem["status"], problem["argument"]) == (415, "Content-Encoding")
    problem = assert_problem(client.post("/lift", content=b" " * 2_000_000, headers=JSON))
    assert (problem["status"], problem["argument"], problem["expected"]) == (413, "body", "at most 1048576 bytes")


@pytest.mark.parametrize(
    ("query", "argument", "expected"),
    [
        ("top=" + "9" * 5000, "top", "an integer of fewer digits"),
        ("view=left&view=right", "view", "one value"),
        ("threshold=0.1&threshold=0.2", "threshold", "one value"),
    ],
)
def test_parameters_are_single_and_of_bounded_size(
    client: TestClient, query: str, argument: str, expected: str
) -> None:
    problem = assert_problem(client.get(f"/query?text=apple&{query}"))
    assert (problem["status"], problem["argument"], problem["expected"]) == (422, argument, expected)
    problem = assert_problem(client.get("/assets?limit=1&limit=2"))
    assert (problem["status"], problem["argument"]) == (422, "limit")
