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
from contextlib import contextmanager
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

from threadpoolctl import ThreadpoolController

if TYPE_CHECKING:
    from collections.abc import Iterator


class _Torch:
    """Torch's thread counts, while any thread is in `one_thread`."""

    def __init__(self) -> None:
        self._lock, self._within, self._previous = Lock(), 0, 1

    def enter(self) -> int | None:
        """Set one thread for the calling thread and threads that start later; return its previous count.

        None if torch is not loaded: queries do without it, and it takes a second to load.
        """
        if "torch" not in sys.modules:
            return None
        import torch

        with self._lock:
            threads = torch.get_num_threads()
            self._previous = self._previous if self._within else threads
            self._within += 1
            torch.set_num_threads(1)
            return threads

    def leave(self, threads: int | None) -> None:
        """Restore the calling thread's count, and set that of threads that start later: 1 while others are within."""
        if threads is None:
            return
        import torch

        with self._lock:
            self._within -= 1
            later_threads = 1 if self._within else self._previous
            torch.set_num_threads(threads)
            if later_threads != threads:
                setter = Thread(target=torch.set_num_threads, args=(later_threads,))
                setter.start()
                setter.join()


class _LinearAlgebra:
    """The thread counts of linear algebra libraries, while any thread is in `one_thread`."""

    def __init__(self) -> None:
        self._lock, self._within = Lock(), 0
        self._modules, self._libraries = 0, list[Any]()  # number at the last search for libraries, and its result
        self._previous: dict[str, int] = {}  # counts by library file

    def enter(self) -> None:
        """Set one thread for all libraries that are loaded."""
        with self._lock:
            if self._modules != len(sys.modules):  # an import may have loaded another; a search takes 1 ms
                self._libraries = ThreadpoolController().select(user_api="blas").lib_controllers
                self._modules = len(sys.modules)
            for library in self._libraries:
                if library.filepath not in self._previous:
                    self._previous[library.filepath] = library.num_threads
                    _set_threads(library, 1)
            self._within += 1

    def leave(self) -> None:
        """Restore the counts when the last thread leaves."""
        with self._lock:
            self._within -= 1
            if not self._within:
                for library in self._libraries:
                    _set_threads(library, self._previous[library.filepath])
                self._previous.clear()


def _set_threads(library: Any, number: int) -> None:
    """Set a library's thread count from any thread.

    From threadpoolctl 3.7 on, OpenBLAS accepts counts only from the thread that set it last, and silently ignores
    others; but the first thread to enter `one_thread` may be the first to leave.
    """
    clear = getattr(library, "clear_controlling_thread", lambda *, force: None)
    clear(force=True)
    library.set_num_threads(number)
    clear(force=True)


_torch, _linear_algebra = _Torch(), _LinearAlgebra()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch and linear algebra in the calling thread alone.

    Threads that start within also have one torch thread, for their lifetime.
    """
    _linear_algebra.enter()
    threads = _torch.enter()
    try:
        yield
    finally:
        _torch.leave(threads)
        _linear_algebra.leave()
