"""The next view is read while the card walks this one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

Item = TypeVar("Item")
Made = TypeVar("Made")


def made_ahead(items: Iterable[Item], make: Callable[[Item], Made]) -> Generator[tuple[Item, Made]]:
    """Every item and what is made of it, in their order; a thread takes and makes the next one meanwhile.

    Raises:
        Exception: what the items or ``make`` raise, in their turn.
    """
    source = iter(items)

    def following() -> tuple[Item, Made] | None:
        for item in source:
            return item, make(item)
        return None

    with ThreadPoolExecutor(1, "view-ahead") as pool:
        waiting = pool.submit(following)
        while (found := waiting.result()) is not None:
            waiting = pool.submit(following)
            yield found
