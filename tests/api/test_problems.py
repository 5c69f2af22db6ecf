"""Every error has the one shape of RFC 9457, on every route."""

from __future__ import annotations

import errno
import gzip
import json
import math
import re
import sqlite3
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from liftcore.errors import SplatliftError
from liftcore.query.terms import NOTATIONS
from liftcore.values.settings import LiftSettings
from service import errors, problems
from service.child import error_of, fault_of
from service.models import TRADEOFF_SETTING
from service.problems import TABLE, problem_of

from .conftest import SceneAssets

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


@pytest.mark.parametrize(
    ("change", "status", "kind"),
    [
        ({"settings": {"preset": "magic"}}, 422, "invalid-settings"),
        ({"settings": {"power": 3}}, 422, "invalid-settings"),
        ({"settings": {"self": 1}}, 422, "invalid-settings"),
        ({"settings": {"a\nb": 1}}, 422, "invalid-settings"),
        ({"settings": {"\ud800": 1}}, 422, "invalid-settings"),
        ({"settings": {"preset": "\ud800"}}, 422, "invalid-settings"),
        ({"settings": {"preset": ["row-sum"]}}, 422, "invalid-request"),
        ({"settings": {"lift_gain": math.nan}}, 422, "invalid-settings"),
        ({"splats": NO_ASSET}, 404, "not-found"),
        ({"features": []}, 422, "invalid-request"),
        ({"cameras": "sha256:short"}, 422, "invalid-request"),
        ({"extra": 1}, 422, "invalid-request"),
    ],
)
def test_bad_order_is_refused_before_it_is_a_job(
    client: TestClient, scene_assets: SceneAssets, change: dict[str, Any], status: int, kind: str
) -> None:
    before = len(client.get("/jobs").json()["jobs"])
    content = json.dumps(scene_assets.order() | change)
    reply = client.post("/lift", content=content, headers={"Content-Type": "application/json"})
    body = assert_problem(reply)
    assert (body["status"], body["type"]) == (status, f"/problems/{kind}")
    assert len(client.get("/jobs").json()["jobs"]) == before


def test_assets_in_a_wrong_place_are_refused(client: TestClient, scene_assets: SceneAssets) -> None:
    body = assert_problem(client.post("/lift", json=scene_assets.order() | {"splats": scene_assets.cameras}))
    assert body["status"] == 404 and "cameras" in body["got"]


@pytest.mark.parametrize(
    ("method", "path", "options", "argument", "expected", "got"),
    [
        ("POST", "/query", {"content": b'{"text": ["\xc4pfel"]}', "headers": {"Content-Type": "application/json"}},
         "body", "JSON in UTF-8", "bytes that are none"),
        ("GET", "/query?text=", {}, "text.0", "at least 1 character", "''"),
        ("GET", "/query?text=apple&top=many", {}, "top", "a valid integer", "'many'"),
        ("GET", "/query?text=apple&lift=x", {}, "lift", "text that matches pattern '^[0-9a-f]{32}$'", "'x'"),
        ("POST", "/lift", {"json": {"splats": NO_ASSET, "cameras": NO_ASSET, "features": []}},
         "features", "at least 1 item", "[]"),
        ("GET", "/querry", {}, "path", "a route of this service", "/querry"),
    ],
)  # fmt: skip
def test_refusal_names_the_argument_and_what_was_expected(
    client: TestClient, method: str, path: str, options: dict[str, Any], argument: str, expected: str, got: str
) -> None:
    body = assert_problem(client.request(method, path, **options))
    assert (body["argument"], body["expected"], body["got"]) == (argument, expected, got) and body["hint"]


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


def test_media_type_of_json_may_be_in_capitals(client: TestClient) -> None:
    problem = assert_problem(client.post("/lift", content=b"{}", headers={"Content-Type": "Application/JSON"}))
    assert problem["argument"] == "splats"


THRESHOLD = "auto, valley, paper, otsu, stability, or a number from -1 to 1"
EXAMPLE = f"{NOTATIONS}, or a vector of 1 to 65536 finite numbers"


@pytest.mark.parametrize("media", [None, "application/x-www-form-urlencoded", "text/plain"])
def test_json_without_its_content_type_gives_an_error_that_names_the_header(
    client: TestClient, media: str | None
) -> None:
    headers = {} if media is None else {"Content-Type": media}
    problem = assert_problem(client.post("/query", content=b'{"text": ["apple"]}', headers=headers))
    assert (problem["status"], problem["argument"], problem["expected"]) == (415, "Content-Type", "application/json")
    assert problem["got"] == ("nothing" if media is None else repr(media))
    assert "Content-Type: application/json" in problem["hint"]


@pytest.mark.parametrize(
    ("body", "got"),
    [
        (b"{", "its end at character 2"),
        (b'{"text": x}', "'x}' at character 10"),
        (b"{} {}", "'{}' at character 4"),
        (b"[]", None),
        (b"", None),
    ],
)
def test_what_is_no_json_says_where_and_no_object_says_so(client: TestClient, body: bytes, got: str | None) -> None:
    problem = assert_problem(client.post("/query", content=body, headers=JSON))
    assert (problem["status"], problem["argument"]) == (422 if got is None else 400, "body")
    assert problem["expected"] == ("a JSON object" if got is None else "JSON")
    assert got is None or problem["got"].startswith(got), problem


@pytest.mark.parametrize(
    ("body", "argument", "expected"),
    [
        ('{"like": [[NaN]]}', "like.0", EXAMPLE),
        ('{"like": [[]]}', "like.0", EXAMPLE),
        ('{"like": ["splat:1", [1, "x"]]}', "like.1", EXAMPLE),
        ('{"unlike": [[true]]}', "unlike.0", EXAMPLE),
        ('{"like": [[' + "0," * 65_536 + "0]]}", "like.0", EXAMPLE),
        ('{"like": "splat:1"}', "like", "a valid list"),
        ('{"threshold": true}', "threshold", THRESHOLD),
        ('{"threshold": NaN}', "threshold", THRESHOLD),
        ('{"top": true}', "top", "a number"),
        ('{"instances": false}', "instances", "a number"),
        ('{"threshold": "high"}', "threshold", THRESHOLD),
        ('{"threshold": 1.01}', "threshold", THRESHOLD),
        ('{"keep": "some"}', "keep", "'all' or 'largest'"),
    ],
)
def test_field_of_a_query_says_what_it_takes(client: TestClient, body: str, argument: str, expected: str) -> None:
    problem = assert_problem(client.post("/query", content=body, headers=JSON))
    assert (problem["status"], problem["argument"], problem["expected"]) == (422, argument, expected)
    assert len(problem["got"]) < 200


@pytest.mark.parametrize(
    ("path", "body", "argument", "known_names"),
    [
        ("/query", {"negative": ["x"]}, "negative", "negatives"),
        ("/query", {"x" * 500: 1}, "x" * 80, "text"),
        ("/lift", {"knobs": {}}, "knobs", "settings"),
        ("/tradeoff", {"labels": {"mask": 1}}, "labels.mask", "masks, table, classes"),
        ("/lift", {"settings": {"x" * 500: 1}}, "x" * 80, "preset, quality, "),
    ],
)
def test_unknown_field_is_refused_with_the_known_ones(
    client: TestClient, path: str, body: dict[str, Any], argument: str, known_names: str
) -> None:
    order = {} if path == "/query" else {"splats": NO_ASSET, "cameras": NO_ASSET, "features": [NO_ASSET]}
    problem = assert_problem(client.post(path, json=order | body))
    assert (problem["status"], problem["argument"]) == (422, argument)
    assert problem["expected"].startswith("one of ") and known_names in problem["expected"]
    assert problem["got"] in (repr(argument.rpartition(".")[2]), "an unknown setting")


@pytest.mark.parametrize("name", ["text", "negatives"])
def test_texts_have_a_length_together(client: TestClient, name: str) -> None:
    for texts in (["a" * 1000] * 4 + ["b"], ["a" * 126] * 32):
        problem = assert_problem(client.post("/query", json={"text": ["apple"], name: texts}))
        assert (problem["status"], problem["argument"]) == (422, name)
        assert problem["expected"] == f"texts of at most 4000 characters together, which are {len(''.join(texts))}"
    assert "4000" not in client.post("/query", json={"text": ["apple"], name: ["a" * 125] * 32}).text


def test_missing_parameter_and_a_value_of_another_type_are_named(client: TestClient) -> None:
    problem = assert_problem(client.get("/render"))
    assert (problem["argument"], problem["expected"], problem["got"]) == ("view", "a value", "nothing")
    order = {"splats": NO_ASSET, "cameras": NO_ASSET, "features": [NO_ASSET]}
    problem = assert_problem(client.post("/tradeoff", json=order | {"budget_s": True}))
    assert (problem["argument"], problem["expected"], problem["got"]) == ("budget_s", "a number", "True")
    problem = assert_problem(client.post("/lift", json=order | {"settings": {"power": None}}))
    assert (problem["argument"], problem["expected"]) == ("settings.power", "a boolean, a number or a text")


def test_settings_have_the_types_that_the_document_shows(client: TestClient) -> None:
    order = {"splats": NO_ASSET, "cameras": NO_ASSET, "features": [NO_ASSET]}
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    for path, schema, left_out in (
        ("/lift", "LiftRequest", set()),
        ("/tradeoff", "TradeoffRequest", {TRADEOFF_SETTING}),
    ):
        fields = schemas[schema]["properties"]["settings"]
        assert set(fields["properties"]) == set(LiftSettings.model_fields) - left_out
        assert fields["additionalProperties"] is False
        assert fields["properties"]["stride"]["type"] == "integer"
        problem = assert_problem(client.post(path, json=order | {"settings": {"stride": "2"}}))
        assert (problem["status"], problem["argument"], problem["expected"]) == (422, "stride", "a valid integer")
        for example in fields["examples"]:  # right, so it is the assets that are missed
            assert client.post(path, json=order | {"settings": example}).status_code == 404


FREE = {"/healthz", "/readyz", "/version", "/metrics"}


def test_every_route_refuses_what_it_does_not_declare(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    assert "Problem" in document["components"]["schemas"]
    assert "HTTPValidationError" not in document["components"]["schemas"]
    operations = [
        (path, method, entry) for path, methods in document["paths"].items() for method, entry in methods.items()
    ]
    for path, method, operation in operations:
        if path in FREE:
            continue
        declared_names = [
            parameter["name"]
            for parameter in operation.get("parameters", ())
            if parameter["in"] == "query" and not parameter.get("deprecated")
        ]
        address = re.sub(r"\{\w+\}", UNKNOWN_ID, path.replace("{asset}", NO_ASSET if method != "put" else "splats"))
        body: dict[str, Any] = {"json": {"text": ["x"]}} if method == "post" and path.startswith("/query") else {}
        problem = assert_problem(client.request(method, address, params={"colour": "red"}, **body))
        assert (problem["status"], problem["type"]) == (422, "/problems/invalid-request"), (method, path, problem)
        if method != "post":  # there the body's error comes first
            assert (problem["argument"], problem["got"]) == ("colour", "'colour'"), (method, path, problem)
            expected = f"one of {', '.join(declared_names)}" if declared_names else "no parameters"
            assert set(problem["expected"].split(", ")) == set(expected.split(", ")), (method, path, problem)


@pytest.mark.parametrize(
    "path", ["/healthz?probe=1", "/readyz?probe=1", "/version?x", "/metrics?x", "/?lift=x&view=y"]
)
def test_probes_and_links_to_the_page_may_carry_what_they_like(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 200
