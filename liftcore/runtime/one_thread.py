"""Torch without threads of its own.

What it cuts into parts for several threads may end in other last bits, and its threads go on spinning for a while
after every call: beside threads that walk and solve they took a tenth of a lift.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch works in the thread that calls it alone.

    So it does in threads that begin meanwhile, for as long as they live: two of these in two threads of a process at
    once may leave it so for threads of later.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
