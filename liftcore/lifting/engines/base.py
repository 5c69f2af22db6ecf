"""What an engine is: somebody who does numbered pieces of work that do not know of one another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol

from liftcore.runtime.arguments import check_count
from liftcore.runtime.one_line import one_line

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.lifting.engines.blocks import Job

    Work = Callable[[Job, int, int | None], None]  # of a job, the number of a piece, and the threads for it


class Engine(Protocol):
    """Does pieces of a job, each at least once. A piece reads files and writes others, whole or not at all.

    So it does no harm that one is begun again elsewhere: no bit of a lift depends on who did what, nor when.
    """

    @property
    def scratch(self) -> Path | None:
        """A folder that all workers share, for lifts that were given none; None: the system's temporary one."""
        ...

    def run(self, work: Work, job: Job, pieces: int) -> Iterator[int]:
        """Do ``work(job, piece, threads)`` for all pieces below that number; give each when it is done, in any order.

        Raises:
            SplatliftError, OSError: what a piece raised. Unavailable: there is nobody who can do a piece.
        """
        ...


class LocalEngine:
    """This process does one piece after the other, with threads.

    It bounds the memory of a lift by its blocks, whatever the number of views and splats.

    Args:
        threads: None takes the cores that this process may use. The number changes no bit.
    """

    scratch: Path | None = None

    def __init__(self, threads: int | None = None) -> None:
        check_count("threads", threads, "all cores")
        self.threads = threads

    def __repr__(self) -> str:
        return one_line(self, f"threads={self.threads}")

    def run(self, work: Work, job: Job, pieces: int) -> Iterator[int]:
        """See the protocol."""
        for piece in range(pieces):
            work(job, piece, self.threads)
            yield piece
