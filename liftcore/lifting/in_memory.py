"""A lift in the memory of one process: all of W is one piece."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from liftcore.lifting.algebra import WeightStatistics
from liftcore.lifting.geometry import Geometry, weigh_views
from liftcore.lifting.pieces import Pieces
from liftcore.lifting.planning.contradictions import contradictions, probe_views
from liftcore.lifting.planning.plan import Plan
from liftcore.lifting.steps import row_arrays
from liftcore.raster import open_raster
from liftcore.runtime.one_thread import one_thread

if TYPE_CHECKING:
    from liftcore.lifting.checkpoint import Checkpoint
    from liftcore.lifting.inputs import LiftInputs
    from liftcore.runtime.progress import Timings
    from liftcore.values.settings import LiftSettings


@one_thread()
def pieces_of(
    geometry: Geometry,
    means: Tensor,
    settings: LiftSettings,
    names: tuple[str, ...],
    *,
    threads: int | None = None,
    memory_limit: int | None = None,
) -> Pieces:
    """Return W of all views in one piece, before any step.

    Args:
        means: [P, 3], of the splats. names: of the views. memory_limit: bytes of X beyond which it is a mapped file.
    """
    W, book = geometry.weights, geometry.codebook
    pieces = Pieces(
        settings=settings, names=names, splats=W.splats.shape[0], channels=book.channels, memory_limit=memory_limit
    )
    pieces.arrays["scene", None] = {"means": means, "codebook": book, "samples": geometry.samples}
    pieces.save("regions", None, {"offsets": W.offsets, "levels": geometry.levels})
    tensors = {"splats": W.splats, "starts": W.indptr, "region": W.region, "weight": W.weight}
    pieces.save("weights", 0, tensors)
    pieces.save("rows", 0, *row_arrays(pieces, W, means, geometry.total_weight(), threads))
    return pieces


def weigh_in_memory(
    inputs: LiftInputs,
    plan: Plan,
    on_plan: Callable[[Plan], None],
    timings: Timings,
    threads: int | None,
    checkpoint: Checkpoint | None,
) -> tuple[Pieces, WeightStatistics]:
    """Compute W of the plan's views; call ``on_plan`` once, as soon as contradictions of the inputs are known."""
    splats, views, settings = inputs.splats, inputs.views, inputs.settings
    raster = open_raster(splats, plan.device, threads)
    first, plans = probe_views(len(views)), [plan]

    def check_first(geometry: Geometry) -> None:
        if views.features.paths:
            warnings = contradictions(raster, views, settings, plan.seen_share, geometry)
            plans.append(replace(plan, input_warnings=(*plan.input_warnings, *warnings)))
        on_plan(plans[-1])

    geometry = weigh_views(
        raster, splats.count, views, settings, timings.progress, by_rows=settings.weighs_rows, threads=threads,
        checkpoint=checkpoint.of(splats, plan.device.facts()) if checkpoint else None,
        first=first, on_first=check_first,
    )  # fmt: skip
    pieces = pieces_of(
        geometry, splats.means, settings, views.names, threads=threads, memory_limit=plan.features_room
    )
    return pieces, WeightStatistics(plans[-1], geometry.levels, geometry.weights.region.shape[0], geometry.blind)
