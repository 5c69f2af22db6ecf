"""Views walked one after the other, or several at a time.

Two views on a core each leave nothing waiting for the last share of a stage, and the few steps of a view that have
one thread only are made beside those of another: on two cores a fifth of the time (docs/speed.md).
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import TYPE_CHECKING

import torch

from liftcore.raster.base import RayRows, ViewWeights

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Sequence

    from liftcore.raster.base import Raster, ViewRequest

VIEWS = 4  # at a time, at most: each needs records and tile lists of its own


def views_at_a_time(threads: int) -> int:
    """How many views so many threads walk side by side."""
    return min(threads, VIEWS)


def walk_view(raster: Raster, look: ViewRequest) -> ViewWeights:
    """What a lift needs of one view."""
    weights = raster.region_weights(look.camera, look.observation, look.params, look.weighting)
    return ViewWeights(
        weights, raster.ray_rows(look.camera, look.pixels, look.params) if len(look.pixels) else _no_rows()
    )


def _no_rows() -> RayRows:
    return RayRows(torch.zeros(1, dtype=torch.int64), torch.empty(0, dtype=torch.int32), torch.empty(0))


def one_by_one(raster: Raster, looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
    """``Raster.iterate_views`` with one view at a time."""
    try:
        for look in looks:
            yield walk_view(raster, look)
    finally:
        raster.forget()


def side_by_side(rasters: Sequence[Raster], looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
    """``Raster.iterate_views`` with as many views at a time as there are rasters of the scene.

    The next look is taken, and its view read, while the others walk. Results come in the order of the looks; what
    they are does not depend on which raster walked where. When the iterator is closed, the views in work are awaited.
    """
    if len(rasters) == 1:
        yield from one_by_one(rasters[0], looks)
        return
    free: SimpleQueue[Raster] = SimpleQueue()
    for raster in rasters:
        free.put(raster)

    def walk(look: ViewRequest) -> ViewWeights:
        raster = free.get()
        try:
            return walk_view(raster, look)
        finally:
            free.put(raster)

    pool = ThreadPoolExecutor(len(rasters))
    try:
        waiting = deque()
        for look in looks:
            waiting.append(pool.submit(walk, look))
            if len(waiting) > len(rasters):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        for raster in rasters:
            raster.forget()
