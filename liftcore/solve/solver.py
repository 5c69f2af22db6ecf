"""Which code makes the closed form: compiled for the processor, or torch's own operations on a card."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Protocol

import torch

from liftcore.device import out_of_memory
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.on_device import Place, solve_on_device
from liftcore.solve.view_weights import ViewWeights

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np

    from liftcore.device import Device
    from liftcore.progress import Progress
    from liftcore.raster.protocol import RegionWeights
    from liftcore.solve.closed_form import Solution
    from liftcore.solve.columns import Columns
    from liftcore.solve.feature_room import FeatureRoom
    from liftcore.solve.host import Host


class ClosedForm(Protocol):
    """``X = D^-1 W E`` with W and E of every view, as `solve_closed_form` describes them."""

    def __call__(
        self,
        store: Sequence[RegionWeights] | ViewWeights,
        columns: Callable[[int], Columns],
        denominators: np.ndarray,
        dtype: torch.dtype,
        progress: Progress,
    ) -> Solution:
        """X and the agreement of each splat's inputs, on the host."""
        ...


def closed_form_on(device: Device, host: Host) -> ClosedForm:
    """The closed form where the lift runs, cut to the memory that is free there now.

    Args:
        host: where X is to lie in any case; what solves, if it is the processor.
    """
    if device.kind == "cpu":
        return partial(solve_closed_form, host=host)
    return partial(_solve_on_card, device, host.room)


def _solve_on_card(
    device: Device,
    feature_room: FeatureRoom,
    store: Sequence[RegionWeights] | ViewWeights,
    columns: Callable[[int], Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
) -> Solution:
    """``solve_on_device``; weights that lie on the card are brought home when nothing else makes room there."""
    while True:
        if device.place.type == "cuda":
            torch.cuda.empty_cache()  # what the walks held, and need no more
        place = Place(device.place, device.free_bytes())
        try:
            return solve_on_device(store, columns, denominators, dtype, progress, place, feature_room)
        except RuntimeError as error:
            if not (out_of_memory(error) and isinstance(store, ViewWeights) and store.card_bytes):
                raise
        store.bring_home()
