"""What the solution has of this machine, and how it shares splats among its threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.solve.curve import places_along_curve
from liftcore.solve.feature_room import in_memory
from liftcore.solve.gathering import EachShare

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from torch import Tensor

    from liftcore.solve.feature_room import FeatureRoom

FEW_CHANNELS = 128  # that are summed sooner than put into another order

SHARES, LEAST_SHARE = 8, 128  # of each thread, so that none waits long for another; splats of a share


@dataclass(frozen=True)
class Host:
    """Threads, memory for X, and the order of splats. Threads and means change no bit of X, only its time."""

    threads: int | None = None  # None takes the cores that this process may use
    room: FeatureRoom = in_memory  # for X
    means: Tensor | None = None  # [P, 3] f32, of the splats: neighbours are solved together; None: in their order

    def places(self, channels: int) -> np.ndarray | None:
        """[P] places along a curve, where an order by them pays for so many channels; None keeps the file's."""
        return None if self.means is None or channels <= FEW_CHANNELS else places_along_curve(self.means)

    @contextmanager
    def workers(self) -> Iterator[tuple[ThreadPoolExecutor, EachShare]]:
        """The threads, and what has them go through splats."""
        threads = self.threads or len(os.sched_getaffinity(0))
        with ThreadPoolExecutor(threads) as pool:

            def each_share(work: Callable[[int, int], None], first: int, last: int) -> None:
                count = max(1, min(SHARES * threads, (last - first) // LEAST_SHARE))
                edges = [first + (last - first) * k // count for k in range(count + 1)]
                list(pool.map(work, edges[:-1], edges[1:]))

            yield pool, each_share


ALL_CORES = Host()
