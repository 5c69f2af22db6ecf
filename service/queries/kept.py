"""A cache with a size."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


def _one(value: object) -> int:
    return 1


class Kept(Generic[T]):
    """The values used last, as many as fit; the very last is kept whatever its size.

    Args:
        limit: how much they may be together.
        size_of: how much one is; left out, each is one.
    """

    def __init__(self, limit: int, size_of: Callable[[T], int] = _one) -> None:
        self.limit = limit
        self._size_of = size_of
        self._values: OrderedDict[object, tuple[T, int]] = OrderedDict()  # with how much each is
        self._size = 0

    @property
    def size(self) -> int:
        """How much is kept."""
        return self._size

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def get(self, key: object, make: Callable[[], T]) -> T:
        """The value of a key, made when it is not here."""
        if key not in self._values:
            self._make_room(1)  # of values that are one each, the old and the new are never here together
            self.put(key, make())
        self._values.move_to_end(key)
        return self._values[key][0]

    def put(self, key: object, value: T) -> None:
        """Keep a value."""
        _, old = self._values.pop(key, (None, 0))
        self._size -= old
        size = self._size_of(value)
        self._make_room(size)
        self._values[key] = value, size
        self._size += size

    def _make_room(self, coming: int) -> None:
        while self._values and self._size + coming > self.limit:
            _, (_, size) = self._values.popitem(last=False)
            self._size -= size
