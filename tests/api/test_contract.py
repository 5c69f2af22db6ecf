"""The service does what its OpenAPI document says, over real sockets, with keys and one example of each operation.

`make contract` is the long form: every corner of the schema, many examples, without keys too.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.values.settings import LiftSettings

from .contract import conformance, serve


@pytest.fixture
def copied(data: Path, lift: dict[str, Any], tmp_path: Path) -> Path:
    """A store with a real lift, to do with as schemathesis likes."""
    folder = tmp_path / "data"
    shutil.copytree(data, folder, ignore=shutil.ignore_patterns("lock", "*-shm", "tmp"))
    return folder


def references(document: Any) -> Iterator[str]:
    if isinstance(document, dict):
        yield from [document["$ref"]] if isinstance(document.get("$ref"), str) else []
        document = list(document.values())
    if isinstance(document, list):
        for part in document:
            yield from references(part)


def test_document_refers_to_what_is_in_it(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    for reference in set(references(document)):
        node = document
        for part in reference.removeprefix("#/").split("/"):
            assert part in node, reference
            node = node[part]


def test_document_has_every_setting_of_a_lift_with_its_meaning(client: TestClient) -> None:
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    fields = schemas["LiftRequest"]["properties"]["settings"]["properties"]
    assert fields.keys() == LiftSettings.model_fields.keys()
    assert fields["smoothness"]["description"]


def test_operations_have_names_of_functions_and_a_sentence(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    operations = [operation for methods in paths.values() for operation in methods.values()]
    names = [operation["operationId"] for operation in operations]
    assert len(set(names)) == len(names) and all(re.fullmatch(r"[a-z]+(_[a-z]+)*", name) for name in names)
    for operation in operations:
        assert " " in operation["summary"] and "\n" not in operation["summary"], operation["operationId"]
    bodies = paths["/lifts"]["post"]["requestBody"]["content"]
    assert bodies.keys() == {"application/json", "application/octet-stream"}


def test_answers_are_as_the_document_says_and_what_is_deleted_is_gone(copied: Path, table: Path) -> None:
    with serve(copied, keys=True, encoder=f"table:{table}") as (address, secret):
        assert not conformance(address, secret, examples=1, phases=("fuzzing", "stateful"))
