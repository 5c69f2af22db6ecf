"""Torch without threads of its own.

What it cuts into parts for several threads may end in other last bits, and its threads go on spinning for a while
after every call: beside threads that walk and solve they took a tenth of a lift.

Torch keeps two numbers: one of each thread, and one of the process, which threads take that begin later. Setting
either sets both. So where several threads of a process are in `one_thread` at once (a caller's own, a lift each), the
process's number stays 1 until the last of them leaves, or workers of a lift that goes on would take the number of the
lift that ended before it.
"""

from __future__ import annotations

from contextlib import contextmanager
from threading import Lock, Thread
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Iterator


class _Process:
    """The number of the process, while any of its threads is in `one_thread`."""

    def __init__(self) -> None:
        self._lock, self._within, self._usual = Lock(), 0, 1

    def enter(self) -> int:
        """Set one for the calling thread and those that begin later; the calling thread's number before."""
        with self._lock:
            own = torch.get_num_threads()
            self._usual = self._usual if self._within else own
            self._within += 1
            torch.set_num_threads(1)
            return own

    def leave(self, own: int) -> None:
        """Set the calling thread's number as before, and for those that begin later what holds for them now."""
        with self._lock:
            self._within -= 1
            later = 1 if self._within else self._usual
            torch.set_num_threads(own)
            if later != own:
                setter = Thread(target=torch.set_num_threads, args=(later,))
                setter.start()
                setter.join()


_process = _Process()


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch works in the thread that calls it alone.

    So it does in threads that begin meanwhile, for as long as they live.
    """
    own = _process.enter()
    try:
        yield
    finally:
        _process.leave(own)
