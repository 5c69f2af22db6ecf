"""What the query process keeps has a size, whatever its questions look like."""

from __future__ import annotations

from typing import Any

import numpy as np

from liftcore.query.ask import Answer
from liftcore.query.terms import Query, Vector
from service.queries.answers import Kept, _key, bytes_of


def answer_to(query: Query) -> Answer:
    """An answer of a scene without splats."""
    none = np.empty(0, bool)
    return Answer(query, np.empty(0, np.float32), none, 0.5, "fixed", "as asked", none, {})


def test_question_counts_with_its_answer() -> None:
    short = bytes_of(answer_to(Query(("apple",))))
    assert short >= 1024  # an entry is never free
    assert bytes_of(answer_to(Query(("apple", "x" * 1000)))) >= short + 1000
    assert bytes_of(answer_to(Query((Vector((0.5,) * 65_536),)))) >= 65_536 * 24


def test_key_of_a_question_is_short_and_its_own() -> None:
    def asked(text: str, **other: Any) -> dict[str, Any]:
        return {"lift": "a", "encoder": None, "encoder_version": None, "query": {"text": [text]}, **other}

    requests = [
        asked("x" * 1_000_000),
        asked("x" * 999_999),
        asked("x", lift="b"),
        asked("x", encoder="b"),
        asked("x"),
    ]
    keys = [_key(request) for request in requests]
    assert len(set(keys)) == len(keys) and max(map(len, keys)) < 100
    assert _key(asked("x")) == keys[-1]


def test_size_is_that_of_what_is_there() -> None:
    sized: list[str] = []

    def size_of(word: str) -> int:
        sized.append(word)
        return len(word)

    kept: Kept[str] = Kept(10, size_of)
    for word in ("one", "three", "one", "seven", "one", "eleven"):
        kept.put(word, word)
        assert kept.size <= 10
    kept.put("eleven", "twelve...")
    assert (kept.size, "eleven" in kept, "one" in kept) == (9, True, False)
    assert len(sized) == 7  # each once: a look at all of them at each question would be slow
