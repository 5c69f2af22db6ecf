"""Engines run a lift in blocks of views and of splats: in this process, or by the workers of a Ray cluster.

An engine runs numbered and independent pieces of work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

from liftcore.errors import InvalidSettings
from liftcore.runtime.arguments import check_count
from liftcore.runtime.one_line import one_line

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.lifting.pieces import Pieces

    Work = Callable[[Any, int, int | None], None]  # of a lift, the number of a piece, and the threads for it

ENGINES = ("local", "ray")


class Engine(Protocol):
    """A runner of the pieces of a lift, each at least once. In blocks a piece reads files and writes others
    atomically.

    So a piece may be repeated elsewhere: the lift is bitwise identical for any assignment and order of pieces.
    """

    @property
    def scratch(self) -> Path | None:
        """A folder that all workers share, for lifts without a checkpoint; None: the system's temporary folder."""
        ...

    def run(self, work: Work, pieces: Pieces, count: int) -> Iterator[int]:
        """Run ``work(pieces, piece, threads)`` for all below ``count``; yield each finished one, in any order.

        Raises:
            SplatliftError, OSError: an error of a piece. Unavailable: no worker can run a piece.
        """
        ...


class LocalEngine:
    """An engine that runs one piece after the other in this process, with threads.

    The memory of a lift in blocks is bounded by their size, for any number of views and splats.

    Args:
        threads: None uses the cores that this process may use. The result is bitwise identical for any value.
    """

    scratch: Path | None = None

    def __init__(self, threads: int | None = None) -> None:
        check_count("threads", threads, "all cores")
        self.threads = threads

    def __repr__(self) -> str:
        return one_line(self, f"threads={self.threads}")

    def run(self, work: Work, pieces: Pieces, count: int) -> Iterator[int]:
        """See the protocol."""
        for piece in range(count):
            work(pieces, piece, self.threads)
            yield piece


def open_engine(name: str | None, address: str | None = None, threads: int | None = None) -> Engine | None:
    """Open the engine of a name, as `liftcore.lift` takes it; return None for None.

    Args:
        name: local or ray. address: of the Ray cluster, ``HOST:PORT`` or ``auto``; None starts one here. threads: of
            the local engine.

    Raises:
        InvalidSettings: the name is unknown, or an address is given without Ray. Unavailable: as in `RayEngine`.
    """
    if name is not None and name not in ENGINES:
        raise InvalidSettings("engine", expected=" or ".join(ENGINES), got=repr(name)[:80])
    if address is not None and name != "ray":
        raise InvalidSettings("address", expected="an address beside the engine ray alone", got=f"engine {name}")
    if name == "ray":
        from liftcore.lifting.engines.ray import RayEngine

        return RayEngine(address)
    return LocalEngine(threads) if name == "local" else None
