"""Torch, and the linear algebra of NumPy and SciPy, without threads of their own.

What they cut into parts for several threads may end in other last bits, and their threads go on spinning for a while
after every call: beside threads that walk and solve torch's took a tenth of a lift, and OpenBLAS's more than half of
a question.

OpenBLAS keeps one number, of the process. Torch keeps two: one of each thread, and one of the process, which threads
take that begin later. Setting either sets both. So where several threads of a process are in `one_thread` at once (a
caller's own, a lift each), the process's numbers stay 1 until the last of them leaves, or workers of a lift that goes
on would take the number of the lift that ended before it.
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
    """Torch's numbers, while any thread that has torch is in `one_thread`."""

    def __init__(self) -> None:
        self._lock, self._within, self._usual = Lock(), 0, 1

    def enter(self) -> int | None:
        """Set one for the calling thread and those that begin later; the calling thread's number before.

        None where torch is not loaded: questions do without, and it takes a second to load.
        """
        if "torch" not in sys.modules:
            return None
        import torch

        with self._lock:
            own = torch.get_num_threads()
            self._usual = self._usual if self._within else own
            self._within += 1
            torch.set_num_threads(1)
            return own

    def leave(self, own: int | None) -> None:
        """Set the calling thread's number as before, and for those that begin later what holds for them now."""
        if own is None:
            return
        import torch

        with self._lock:
            self._within -= 1
            later = 1 if self._within else self._usual
            torch.set_num_threads(own)
            if later != own:
                setter = Thread(target=torch.set_num_threads, args=(later,))
                setter.start()
                setter.join()


class _LinearAlgebra:
    """The numbers of libraries of linear algebra, while any thread is in `one_thread`."""

    def __init__(self) -> None:
        self._lock, self._within = Lock(), 0
        self._modules, self._libraries = 0, list[Any]()  # loaded at the last look for libraries, and what it found
        self._usual: dict[str, int] = {}  # of libraries that have one thread now, by their files

    def enter(self) -> None:
        """Set one for all libraries that are loaded."""
        with self._lock:
            if self._modules != len(sys.modules):  # an import may have loaded another: a look takes a millisecond
                self._libraries = ThreadpoolController().select(user_api="blas").lib_controllers
                self._modules = len(sys.modules)
            for library in self._libraries:
                if library.filepath not in self._usual:
                    self._usual[library.filepath] = library.num_threads
                    _set_threads(library, 1)
            self._within += 1

    def leave(self) -> None:
        """Set the numbers as before, once no thread is within any more."""
        with self._lock:
            self._within -= 1
            if not self._within:
                for library in self._libraries:
                    _set_threads(library, self._usual[library.filepath])
                self._usual.clear()


def _set_threads(library: Any, number: int) -> None:
    """Set a library's number from any thread.

    threadpoolctl from 3.7 on has OpenBLAS obey the thread alone that set it last, and ignores others without a word;
    of those that are in `one_thread` the first to come may be the first to leave.
    """
    clear = getattr(library, "clear_controlling_thread", lambda *, force: None)
    clear(force=True)
    library.set_num_threads(number)
    clear(force=True)


_torch, _linear_algebra = _Torch(), _LinearAlgebra()


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch and linear algebra work in the thread that calls them alone.

    So torch does in threads that begin meanwhile, for as long as they live.
    """
    _linear_algebra.enter()
    own = _torch.enter()
    try:
        yield
    finally:
        _torch.leave(own)
        _linear_algebra.leave()
