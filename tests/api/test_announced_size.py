"""An upload that says itself that it is too large is refused before a byte of it is sent."""

from __future__ import annotations

import json

import pytest
from fastapi.testclient import TestClient

from service.wire import AssetKind

from .test_problems import assert_problem
from .test_slow_clients import answer, client_of, served

LIMITS = {f"max_{kind}_bytes": 1000 for kind in AssetKind}
HEAD = "PUT /assets/{kind} HTTP/1.1\r\nHost: 127.0.0.1\r\nExpect: 100-continue\r\nContent-Length: {length}\r\n"


@pytest.mark.parametrize("length", [1001, 10**19])
def test_announced_length_is_refused_before_the_body_is_asked_for(
    tmp_path_factory: pytest.TempPathFactory, length: int
) -> None:
    with served(tmp_path_factory.mktemp("small") / "data", header_seconds=1, **LIMITS) as address:
        for kind in AssetKind:
            with client_of(address) as connection:
                connection.sendall(f"{HEAD.format(kind=kind, length=length)}Connection: close\r\n\r\n".encode())
                head, body = answer(connection)
            assert head.startswith(b"HTTP/1.1 413 "), head
            told = json.loads(body)
            assert (told["type"], told["expected"]) == (
                "/problems/too-large",
                "at most 1000 bytes, compressed or not",
            )
            assert ("hint" in told) == (kind is AssetKind.FEATURES)


def test_hint_at_several_packs_is_for_features(client: TestClient) -> None:
    pieces = (bytes(100_000) for _ in range(3))  # of a length that nobody announces
    told = assert_problem(client.put("/assets/splats", content=pieces))
    assert told["status"] == 413 and "hint" not in told and "feature" not in told["detail"]
