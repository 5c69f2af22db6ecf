"""Peers on one piece of work in turns, and how their time grows along an axis, within a budget of time."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.benchmarks.peers.agreement import Agreement, agreement
from tests.benchmarks.peers.work import Size, Work, room

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from tests.benchmarks.peers.peer import Peer
    from tests.benchmarks.peers.work import Answer


@dataclass(frozen=True)
class Limits:
    """What the comparison may take. A run expected beyond them is not made, and nothing is put in its place."""

    rounds: int = 3
    peer_s: float = 10.0  # a peer at one size, all rounds, beyond its first
    lift_s: float = 8.0  # one lift, as its peer's last smaller one has it
    total_s: float = 240.0  # after which nothing new begins


@dataclass(frozen=True)
class Run:
    """One peer's lifts of one size."""

    size: Size
    seconds: tuple[float, ...]  # wall time of each lift
    processor: float  # seconds of all threads, the least of the lifts
    agreement: Agreement

    @property
    def median(self) -> float:
        """Seconds."""
        return statistics.median(self.seconds)


@dataclass(frozen=True)
class Axis:
    """One way in which work grows."""

    name: str
    sizes: tuple[Size, ...]  # ascending
    of: Callable[[Size], int]  # what grows


@dataclass(frozen=True)
class Sizes:
    """What is compared: three sizes for all, and growth around the second."""

    small: Size
    base: Size
    large: Size
    axes: tuple[Axis, ...]


@dataclass
class Comparison:
    """A benchmark under way: who takes part, what it may take, and who was cut off where."""

    peers: Sequence[Peer]  # ours first
    threads: int
    limits: Limits
    cuts: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)

    def table(self, title: str, size: Size, smaller: Mapping[str, Run], lift_s: float) -> dict[str, Run]:
        """All peers at a size.

        Args:
            smaller: what they took at a smaller size: who would take longer than ``lift_s`` if his time grew with
                views and pixels alone is cut off. Empty: everybody is run.
        """
        if self._time_is_up(title):
            return {}
        chosen = []
        for peer in self.peers:
            last = smaller.get(peer.name)
            fits = last is not None and self._fits(peer, title, (last, _rays(size) / _rays(last.size)), lift_s)
            if fits or not smaller:
                chosen.append(peer)
        return side_by_side(chosen, room(size, self.threads), self.limits, size)

    def growth(self, axis: Axis, base: Mapping[str, Run]) -> dict[str, list[Run]]:
        """The peers of the base, at every size of the axis that fits the budget."""
        peers = [peer for peer in self.peers if peer.name in base]
        found: dict[str, list[Run]] = {peer.name: [] for peer in peers}
        for size in axis.sizes:
            if size in {run.size for run in base.values()}:
                for name, run in base.items():
                    found[name].append(run)
                continue
            where = f"{axis.name} {axis.of(size):,}"
            if self._time_is_up(where):
                break
            chosen = []
            for peer in peers:
                last = base[peer.name]  # what is smaller takes no longer
                if axis.of(size) > axis.of(last.size) and found[peer.name]:
                    last = found[peer.name][-1]
                factor = max(1.0, axis.of(size) / axis.of(last.size))
                if self._fits(peer, where, (last, factor), self.limits.lift_s):
                    chosen.append(peer)
            for name, run in side_by_side(chosen, room(size, self.threads), self.limits, size).items():
                found[name].append(run)
        return found

    def _fits(self, peer: Peer, where: str, expected: tuple[Run, float], lift_s: float) -> bool:
        last, factor = expected
        if last.median * factor <= lift_s:
            return True
        self.cuts.append(
            f"{peer.name} at {where}: its last smaller lift took {last.median:.2g} s, this one is {factor:.3g} times "
            f"larger, and a lift may take {lift_s:g} s"
        )
        return False

    def _time_is_up(self, where: str) -> bool:
        if time.monotonic() - self.started <= self.limits.total_s:
            return False
        self.cuts.append(f"everybody at {where}: the {self.limits.total_s:g} s of the whole comparison were over")
        return True


def side_by_side(peers: Sequence[Peer], work: Work, limits: Limits, size: Size) -> dict[str, Run]:
    """Every peer lifts the work, in turns: a round of all, then the next. Each is held to the first one's X."""
    seconds: dict[str, list[float]] = {peer.name: [] for peer in peers}
    processor = dict.fromkeys(seconds, math.inf)
    agreements: dict[str, Agreement] = {}
    reference: Answer | None = None
    for _ in range(limits.rounds):
        for peer in peers:
            own = seconds[peer.name]
            if own and sum(own) + own[-1] > limits.peer_s:
                continue
            start, cpu = time.perf_counter(), time.process_time()
            answer = peer.lift(work)
            own.append(time.perf_counter() - start)
            processor[peer.name] = min(processor[peer.name], time.process_time() - cpu)
            reference = reference or answer
            if peer.name not in agreements:
                agreements[peer.name] = agreement(reference, answer)
    return {name: Run(size, tuple(own), processor[name], agreements[name]) for name, own in seconds.items()}


def _rays(size: Size) -> int:
    return size.views * size.width * size.height
