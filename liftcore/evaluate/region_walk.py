"""The walk of a lift over views in memory, for what times lifts: no packs, no sampled rays, no settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.base import ViewRequest
from liftcore.raster.cpu.weights_home import on_host
from liftcore.solve.columns import Columns, by_tuples
from liftcore.solve.totals import row_totals

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.features.views import ViewFeatures
    from liftcore.raster.base import CompositingParams, Raster, Weighting
    from liftcore.scene.cameras import Camera
    from liftcore.solve.view_weights import WeightStore


def walk_regions(
    raster: Raster,
    views: Sequence[tuple[Camera, ViewFeatures]],
    looking: tuple[CompositingParams, Weighting],
    count: int,
    store: WeightStore,
) -> tuple[np.ndarray, list[Columns]]:
    """W of every view into the store; the denominators [P] f64 and the columns of W, as the closed form takes them.

    Args:
        count: P.
    """
    denominators, columns = np.zeros(count), []
    nowhere = torch.empty(0, 2, dtype=torch.int32)

    def looks() -> Iterator[ViewRequest]:
        for camera, observation in views:
            walked, own = by_tuples(observation)
            columns.append(own)
            yield ViewRequest(camera, walked, *looking, nowhere)

    for number, walked in enumerate(raster.iterate_views(looks())):
        weights = columns[number].weighted(walked.weights)
        home = on_host(weights)
        denominators[home.splats.numpy()] += row_totals(home)
        store.append(weights)
    return denominators, columns
