"""Free memory goes back to the system where the allocator can give it, and is no trouble where it cannot."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

from liftcore import heap

if TYPE_CHECKING:
    import pytest


def test_the_allocator_is_asked_to_trim(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda _: SimpleNamespace(malloc_trim=asked.append))
    heap.give_back_free_memory()
    assert asked == [0]


def test_an_allocator_without_that_call_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda _: SimpleNamespace())
    heap.give_back_free_memory()
