"""The next view is read while this one is walked, and nothing of it is seen before its turn."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from liftcore.raster.gpu.ahead import made_ahead


def test_next_item_is_made_while_this_one_is_used():
    made = [threading.Event() for _ in range(4)]

    def make(item: int) -> str:
        made[item].set()
        return str(item)

    found = []
    for item, own in made_ahead(range(3), make):
        assert item == 2 or made[item + 1].wait(timeout=60)
        assert not made[min(item + 2, 3)].is_set()  # one ahead, no more: views take memory
        found.append((item, own))
    assert found == [(0, "0"), (1, "1"), (2, "2")]


def test_nothing_is_ahead_of_nothing():
    assert list(made_ahead([], str)) == []


@pytest.mark.parametrize("source", [True, False], ids=["items", "make"])
def test_what_goes_wrong_is_raised_in_its_turn(source):
    def items() -> Iterator[int]:
        yield 1
        if source:
            raise OSError("gone")
        yield 0

    used = []
    with pytest.raises(OSError if source else ZeroDivisionError):
        used.extend(item for item, _ in made_ahead(items(), lambda item: 1 // item))
    for item, _ in made_ahead([1, 2, 0], lambda item: item):
        used.append(item)
        break  # the thread ends with the loop
    assert used[-1] == 1
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("view-ahead")]
