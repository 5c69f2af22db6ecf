"""A query parameter that a route does not know is refused by name, on every route but the operator's."""

from __future__ import annotations

import re
from typing import Any

import pytest
from fastapi.testclient import TestClient

from .test_problems import NO_ASSET, NOBODY, assert_problem, every_route

FREE = {"/healthz", "/readyz", "/version", "/metrics"}


def test_every_route_refuses_what_it_does_not_declare(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    for method, path in every_route(client):
        if path in FREE:
            continue
        declared = [
            parameter["name"]
            for parameter in paths[path][method.lower()].get("parameters", ())
            if parameter["in"] == "query"
        ]
        address = re.sub(r"\{\w+\}", NOBODY, path.replace("{asset}", NO_ASSET if method != "PUT" else "splats"))
        body: dict[str, Any] = {"json": {"text": ["x"]}} if method == "POST" and path.startswith("/query") else {}
        reply = client.request(method, address, params={"colour": "red"}, **body)
        told = assert_problem(reply)
        assert (told["status"], told["type"]) == (422, "/problems/invalid-request"), (method, path, told)
        if method != "POST":  # where the body is told of first
            assert (told["argument"], told["got"]) == ("colour", "'colour'"), (method, path, told)
            expected = f"one of {', '.join(declared)}" if declared else "no parameters"
            assert set(told["expected"].split(", ")) == set(expected.split(", ")), (method, path, told)


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ("/query?text=mug&negative=lamp", "negative"),
        ("/query/scores?text=mug&view=left", "view"),
        ("/query/mask?text=mug&view=left&top=3", "top"),
        ("/render?view=left&text=mug", "text"),
        ("/jobs?state=running", "state"),
        ("/lifts?" + "a" * 5000, "a" * 80),
    ],
)
def test_misspelt_parameter_is_named(client: TestClient, path: str, wrong: str) -> None:
    told = assert_problem(client.get(path))
    assert (told["status"], told["argument"]) == (422, wrong)
    assert path.startswith(("/jobs", "/lifts")) or "lift" in told["expected"]


@pytest.mark.parametrize(
    "path", ["/healthz?probe=1", "/readyz?probe=1", "/version?x", "/metrics?x", "/?lift=x&view=y"]
)
def test_probes_and_links_to_the_page_may_carry_what_they_like(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 200
