"""304 is for what is there: who asks with If-None-Match gets no answer about things that do not exist."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from .conftest import Uploaded
from .test_problems import assert_problem

PICTURES = ("/render", "/query/mask", "/query/attention")


@pytest.mark.parametrize("path", PICTURES)
def test_any_picture_is_one_that_exists(client: TestClient, lift: dict[str, Any], path: str) -> None:
    asked = {"lift": lift["id"], "view": "left"} | ({} if path == "/render" else {"text": "apple"})
    any_at_all = {"If-None-Match": "*"}
    nothing = client.get(path, params=asked | {"view": "behind"}, headers=any_at_all)
    assert assert_problem(nothing)["status"] == 404
    there = client.get(path, params=asked, headers=any_at_all)
    assert (there.status_code, there.content) == (304, b"")
    assert there.headers["etag"] == client.get(path, params=asked).headers["etag"]


def test_document_says_what_is_answered_beside_200(client: TestClient, uploaded: Uploaded) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    files = ("/assets/{asset}/content", "/lifts/{lift}/features")
    for path in (
        *files,
        *PICTURES,
        "/query/scores",
        "/lifts/{lift}/splats",
        "/lifts/{lift}/colours",
        "/tradeoffs/{tradeoff}/chart",
    ):
        told = paths[path]["get"]["responses"]
        assert "304" in told and "content" not in told["304"], path
        assert ("206" in told, "416" in told) == (path in files, path in files), path
        assert list(told["200"]["content"]), path
    for path in files:
        told = paths[path]["get"]["responses"]
        assert list(told["206"]["content"]) == list(told["200"]["content"]) == ["application/octet-stream"]
        assert list(told["416"]["content"]) == ["application/problem+json"]
    assert "304" not in paths["/query/mask"]["post"]["responses"]
