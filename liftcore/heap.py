"""The allocator's free memory, given back to the system."""

from __future__ import annotations

import ctypes


def give_back_free_memory() -> None:
    """Have the allocator return what is free; where there is no such call (glibc has it), nothing happens.

    Walks leave hundreds of megabytes of pieces between what is kept, and the solution's large arrays fit in none.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
