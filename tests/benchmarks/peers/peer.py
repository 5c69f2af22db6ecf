"""What a peer is: a way to lift that gives the same X, and says what it needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from tests.benchmarks.peers.work import Answer, Work


class Peer(Protocol):
    """A way to lift. It is given splats, cameras, label maps and codebooks, and nothing made of them."""

    name: str
    computes: str  # how, in a sentence

    def missing(self) -> str:
        """Why it cannot run here; empty when it can."""
        ...

    def lift(self, work: Work) -> Answer:
        """All of the work, from the scene to X."""
        ...
