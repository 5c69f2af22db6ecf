"""The service does what its OpenAPI document says, over real sockets. `make contract` is the long form."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from .contract import conformance, served


@pytest.fixture
def copied(data: Path, lift: dict[str, Any], tmp_path: Path) -> Path:
    """A store with a real lift, to do with as schemathesis likes."""
    folder = tmp_path / "data"
    shutil.copytree(data, folder, ignore=shutil.ignore_patterns("lock", "*-shm", "tmp"))
    return folder


def test_every_corner_of_the_schema_is_answered_as_it_says(copied: Path, table: Path) -> None:
    with served(copied, keys=False, encoder=f"table:{table}") as (address, secret):
        # The corners of /query are those of its pictures, over again.
        assert not conformance(address, secret, examples=1, phases=("coverage",), without="^/query/")


def test_keys_are_asked_for_and_what_is_deleted_is_gone(copied: Path, table: Path) -> None:
    with served(copied, keys=True, encoder=f"table:{table}") as (address, secret):
        assert not conformance(address, secret, examples=1, phases=("fuzzing", "stateful"))
