"""The service does what its OpenAPI document says, over real sockets, with keys and one example of each operation."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract import failures_of


@pytest.mark.slow
def test_answers_are_as_the_document_says_and_what_is_deleted_is_gone(tmp_path: Path) -> None:
    assert not failures_of(tmp_path, examples=1, phases=("fuzzing", "stateful"))
