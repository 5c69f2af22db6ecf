"""The walk of a lift over views in memory, for what times lifts: no packs, no sampled rays, no settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.protocol import Look
from liftcore.raster.weights_home import on_host
from liftcore.solve.columns import Columns, by_tuples
from liftcore.solve.totals import row_totals

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.observe.observation import Observation
    from liftcore.raster.protocol import Raster, Walk, Weighting
    from liftcore.scene.cameras import Camera
    from liftcore.solve.view_weights import ViewWeights


def walk_regions(
    raster: Raster,
    views: Sequence[tuple[Camera, Observation]],
    looking: tuple[Walk, Weighting],
    count: int,
    store: ViewWeights,
) -> tuple[np.ndarray, list[Columns]]:
    """W of every view into the store; the denominators [P] f64 and the columns of W, as the closed form takes them.

    Args:
        count: P.
    """
    denominators, columns = np.zeros(count), []
    nowhere = torch.empty(0, 2, dtype=torch.int32)

    def looks() -> Iterator[Look]:
        for camera, observation in views:
            walked, own = by_tuples(observation)
            columns.append(own)
            yield Look(camera, walked, *looking, nowhere)

    for number, walked in enumerate(raster.walk_views(looks())):
        weights = columns[number].weighted(walked.weights)
        home = on_host(weights)
        denominators[home.splats.numpy()] += row_totals(home)
        store.append(weights)
    return denominators, columns
