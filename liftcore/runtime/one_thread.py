"""A context in which torch and the linear algebra of NumPy and SciPy use one thread.

Results that they split over several threads may differ in the last bits, and their threads busy-wait after every
call: beside the threads of rasterization and solve, torch's took a tenth of a lift, and OpenBLAS's more than half of
a query.

OpenBLAS has one thread count, of the process. Torch has two: one of each thread, and one of the process, for threads
that start later. Setting either sets both. If several threads of a process are in `one_thread` at once (one lift
each), the process's counts stay 1 until the last of them leaves; otherwise workers of a running lift would get the
count that another lift restored.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from threading import Lock, Thread
from typing import Any, ClassVar

from threadpoolctl import ThreadpoolController


class _Counts:
    """Thread counts of the process, while any thread is in `one_thread`."""

    within = 0  # threads
    within_torch = 0  # threads that entered when torch was loaded
    later = 1  # torch's count for threads that start when all have left
    modules = 0  # that were loaded at the last search for libraries
    libraries: ClassVar[list[Any]] = []
    previous: ClassVar[dict[str, int]] = {}  # counts by library file


def _set_threads(library: Any, number: int) -> None:
    """Set a library's thread count from any thread."""
    # From threadpoolctl 3.7 on, OpenBLAS accepts counts only from the thread that set it last, and silently ignores
    # others; but the first thread to enter `one_thread` may be the first to leave.
    clear = getattr(library, "clear_controlling_thread", lambda *, force: None)
    clear(force=True)
    library.set_num_threads(number)
    clear(force=True)


_lock = Lock()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch and linear algebra in the calling thread, and all their life in each thread that starts within."""
    # Queries do without torch, which takes a second to load. Where another thread is loading it, this waits for that.
    torch = import_module("torch") if "torch" in sys.modules else None
    with _lock:
        threads = _enter(torch)
    try:
        yield
    finally:
        with _lock:
            _leave(torch, threads)


def _enter(torch: Any) -> int:
    """Set one thread for the calling thread, those that start later, and all libraries; return torch's count."""
    if _Counts.modules != len(sys.modules):  # an import may have loaded another library; a search takes 1 ms
        _Counts.libraries = ThreadpoolController().select(user_api="blas").lib_controllers
        _Counts.modules = len(sys.modules)
    for library in _Counts.libraries:
        if library.filepath not in _Counts.previous:
            _Counts.previous[library.filepath] = library.num_threads
            _set_threads(library, 1)
    _Counts.within += 1
    threads = torch.get_num_threads() if torch else 0
    if torch:
        _Counts.later = _Counts.later if _Counts.within_torch else threads
        _Counts.within_torch += 1
        torch.set_num_threads(1)
    return threads


def _leave(torch: Any, threads: int) -> None:
    """Restore the calling thread's count, and that of the process when the last thread leaves."""
    _Counts.within -= 1
    if not _Counts.within:
        for library in _Counts.libraries:
            _set_threads(library, _Counts.previous[library.filepath])
        _Counts.previous.clear()
    if torch:
        _Counts.within_torch -= 1
        torch.set_num_threads(threads)
        later = 1 if _Counts.within_torch else _Counts.later
        if later != threads:
            setter = Thread(target=torch.set_num_threads, args=(later,))
            setter.start()
            setter.join()
