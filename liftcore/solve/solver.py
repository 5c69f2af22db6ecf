"""Which code makes the closed form: compiled for the processor, or torch's own operations on a card."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.device import out_of_memory
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.on_device import Place, solve_on_device
from liftcore.solve.view_weights import WeightStore

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from liftcore.device import Device
    from liftcore.progress import Progress
    from liftcore.raster.base import RegionWeights
    from liftcore.solve.closed_form import Solution
    from liftcore.solve.columns import Columns
    from liftcore.solve.host import Host


def closed_form(
    store: Sequence[RegionWeights] | WeightStore,
    columns: Sequence[Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    device: Device,
    host: Host,
) -> Solution:
    """``X = D^-1 W E`` and the agreement of each splat's inputs, made on the device and left on the host.

    Weights that lie on a card are brought home when nothing else makes room there.

    Args:
        store, columns, denominators, dtype, progress: as `solve_closed_form` describes them.
        device: where the lift runs; on a card the work is cut to the memory that is free now.
        host: where X is to lie in any case; what solves, if it is the processor.
    """
    if device.kind == "cpu":
        return solve_closed_form(store, columns, denominators, dtype, progress, host)
    while True:
        if device.place.type == "cuda":
            torch.cuda.empty_cache()  # what the walks held, and need no more
        place = Place(device.place, device.free_bytes())
        try:
            return solve_on_device(store, columns, denominators, dtype, progress, place, host.room)
        except RuntimeError as error:
            if not (out_of_memory(error) and isinstance(store, WeightStore) and store.card_bytes):
                raise
        store.bring_home()
