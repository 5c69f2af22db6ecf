"""What the query process promises: questions asked together are answered as alone, and what it keeps has a size."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from liftcore.query import ask
from liftcore.query.ask import Answer
from liftcore.query.objects import objects
from liftcore.query.terms import Query, Vector
from service import models
from service.auth import EVERYBODY
from service.queries import answers
from service.queries.answers import Answers, Kept, bytes_of, reply_to
from service.queries.client import Frame
from service.routes.queries import query_request
from tests.crash.conftest import until

from .conftest import parts_of
from .tiny_scene import CHANNELS, WORDS

AN_ANSWER = 6 * 60 + (2 << 10)  # bytes, for the splats of the tiny scene
AN_IMAGE = 9 * 32 * 24 + (2 << 10)
AXES = [[float(row == channel) for channel in range(CHANNELS)] for row in range(3)]
QUESTIONS: list[dict[str, Any]] = [
    *({"text": [word]} for word in WORDS),
    {"text": list(WORDS), "negatives": ["book"], "threshold": "otsu"},
    {"text": ["lamp"], "like": [AXES[0]]},
    {"like": [AXES[1], [0.3, 0.4, 0, 0, 0, 0, 0, 0.5]], "unlike": [AXES[2]]},
    {"text": ["zeppelin"]},  # which the table does not know
    {"like": ["splat:7"]},
    {"text": ["apple"]},  # again
]


@pytest.fixture
def request_of(client: TestClient, lift: dict[str, Any]) -> Callable[..., dict[str, Any]]:
    """A request as the query process gets it."""
    parts = parts_of(client)
    here = replace(parts, caller=EVERYBODY)  # as for a caller who sees the lift
    record = here.store.lifts.get(here.owner, lift["id"])

    def make(operation: str = "scores", **asked: Any) -> dict[str, Any]:
        body = models.AskedInBody.model_validate({"lift": lift["id"], **asked})
        return query_request(operation, body, record, here) | {"view": "left", "top": 3}

    return make


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of words of each pass over the features."""
    seen: list[int] = []
    original = ask.cosines

    def counted(features: Any, norms: Any, rows: Any) -> Any:
        seen.append(len(rows))
        return original(features, norms, rows)

    monkeypatch.setattr(ask, "cosines", counted)
    return seen


def told(frame: Frame) -> tuple[object, bytes]:
    return frame.header, frame.body


def test_questions_asked_together_are_answered_as_alone_to_the_bit(request_of: Callable[..., dict[str, Any]]) -> None:
    requests = [request_of(operation, **asked) for asked in QUESTIONS for operation in ("scores", "query", "mask")]
    together = Answers(scenes=1, cache_bytes=1 << 20)
    found = [told(reply_to(requests[first:], together)) for first in range(len(requests))]
    alone = [told(reply_to([request], Answers(scenes=1, cache_bytes=0))) for request in requests]
    assert found == alone
    assert sum("fault" in header for header, _ in found if isinstance(header, dict)) == 3
    assert len({body for _, body in found}) > len(QUESTIONS)


def test_large_answer_is_a_file_and_the_same_bytes(
    request_of: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, kept = {"draft": str(tmp_path / "draft")}, Answers(scenes=1, cache_bytes=1 << 20)
    requests = [request_of(operation, text=["apple"]) | asked for operation in ("scores", "mask", "attention")]
    small = [reply_to([request], kept).body for request in requests]
    assert all(small) and not list(tmp_path.iterdir())
    monkeypatch.setattr(answers, "PIPE_BYTES", 10)
    for request, content in zip(requests, small, strict=True):
        assert reply_to([request], kept) == Frame({}) and (tmp_path / "draft").read_bytes() == content


def test_questions_asked_together_take_one_pass_within_cache_and_memory(
    request_of: Callable[..., dict[str, Any]], passes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    requests = [request_of(text=[word], threshold=k / 8) for k in range(4) for word in WORDS]
    for cache_bytes, taken in ((1 << 20, [12]), (5 * (AN_ANSWER + len("apple")), [5, 5, 2])):
        together = Answers(scenes=1, cache_bytes=cache_bytes)
        passes.clear()
        for first in range(len(requests)):
            reply_to(requests[first:], together)
        assert passes == taken
    passes.clear()
    monkeypatch.setattr(answers, "PRODUCT_BYTES", 8 * 4 * 60)
    reply_to(requests, Answers(scenes=1, cache_bytes=1 << 20))
    assert passes == [8]


def test_what_is_kept_stays_within_its_size_over_many_different_questions(
    request_of: Callable[..., dict[str, Any]],
) -> None:
    limit = 10 * AN_ANSWER + 2 * AN_IMAGE
    kept = Answers(scenes=1, cache_bytes=limit)
    sizes = []
    for number in range(300):
        operation = "mask" if number % 3 == 0 else "scores"
        reply_to([request_of(operation, text=["apple"], threshold=number / 300)], kept)
        sizes.append(kept.kept_bytes)
    assert max(sizes) <= limit and min(sizes[50:]) > limit / 2


def test_objects_of_an_answer_are_made_once_for_all_its_masks(
    request_of: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    monkeypatch.setattr(answers, "objects", lambda *both: made.append(0) or objects(*both))
    kept = Answers(scenes=1, cache_bytes=1 << 20)
    reply_to([request_of("scores", text=["apple"])], kept)
    before = kept.kept_bytes
    reply_to([request_of("objects", text=["apple"])], kept)
    assert kept.kept_bytes == before + 4 * 60 + (2 << 10)
    for view in ("left", "middle", "left"):
        reply_to([request_of("mask", text=["apple"]) | {"view": view}], kept)
    assert len(made) == 1
    reply_to([request_of("mask", text=["lamp"])], kept)
    assert len(made) == 2


def test_cache_keeps_what_was_used_last_and_knows_its_size() -> None:
    sized: list[str] = []
    kept: Kept[str] = Kept(7, lambda word: sized.append(word) or len(word))
    for word in ("one", "two", "three", "three"):
        kept.put(word, word)
        assert kept.size <= 7
    assert ("one" in kept, "two" in kept, "three" in kept) == (False, False, True)
    assert kept.get("two", lambda: "2") == "2" and kept.get("three", lambda: "again") == "three"
    kept.put("long", "longer than all")
    assert kept.size == len("longer than all")
    assert kept.get("long", lambda: "again") == "longer than all"
    assert len(sized) <= 6  # each once: a look at all of them at each question would be slow


def test_question_counts_with_its_answer() -> None:
    none, no_scores = np.empty(0, bool), np.empty(0, np.float32)
    short, long, vector = (
        bytes_of(Answer(Query(terms), no_scores, none, 0.5, "fixed", "as asked", none, {}))
        for terms in (("apple",), ("apple", "x" * 1000), (Vector((0.5,) * 65_536),))
    )
    assert short >= 1024 and long >= short + 1000 and vector >= 65_536 * 24  # an entry is never free


def test_calls_of_a_worker_that_dies_are_answered_by_the_next(client: TestClient, lift: dict[str, Any]) -> None:
    worker = parts_of(client).queries
    process = worker._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)  # so that all calls are in the line, and the first asked, when it dies
    replies: list[int] = []

    def run(number: int) -> None:
        asked = {"text": "book", "lift": lift["id"], "threshold": 0.5 + number / 100}
        replies.append(client.get("/query", params=asked).status_code)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    until(lambda: worker.waiting == 3)
    os.kill(process.pid, signal.SIGKILL)
    for thread in threads:
        thread.join()
    assert replies == [200] * 4
