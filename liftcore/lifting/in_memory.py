"""A lift in the memory of one process: all of W is one piece."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.algebra import WeightStatistics
from liftcore.lifting.geometry import Geometry, weigh_views
from liftcore.lifting.pieces import Pieces, Shape
from liftcore.lifting.planning.contradictions import contradictions, probe_views
from liftcore.lifting.planning.plan import TIMED_VIEWS, Plan
from liftcore.lifting.steps import row_arrays
from liftcore.raster import open_raster
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.sums import PieceSums, sum_pieces

if TYPE_CHECKING:
    from liftcore.lifting.checkpoint import Checkpoint
    from liftcore.lifting.inputs import LiftInputs
    from liftcore.runtime.progress import Timings
    from liftcore.solve.codebook import Codebook
    from liftcore.solve.directions import RegionDirections
    from liftcore.solve.rays import SampledRays
    from liftcore.values.settings import LiftSettings


@dataclass(frozen=True, kw_only=True)
class InMemory(Pieces):
    """A lift in one piece, in the memory of this process."""

    centres: Tensor  # [P, 3], of the splats
    vectors: Codebook
    rays: Sequence[SampledRays] = ()
    memory_limit: int | None = None  # bytes of X, beyond which it is a mapped file; None for no limit
    arrays: dict[tuple[str, int | None], dict[str, Any]] = field(default_factory=dict)

    @property
    def means(self) -> Tensor:
        return self.centres

    @property
    def codebook(self) -> Codebook:
        return self.vectors

    def has(self, step: str, number: int) -> bool:
        return (step, number) in self.arrays

    def load(self, step: str, number: int | None = None) -> dict[str, Any]:
        return self.arrays[step, number]

    def save(
        self,
        step: str,
        number: int | None,
        arrays: dict[str, Any],
        sums: Iterable[PieceSums] = (),
        shape: Shape | None = None,
    ) -> None:
        parts = list(sums) if shape is None else [PieceSums.of(sum_pieces(sums, shape))]
        columns = {name: part.numpy() if isinstance(part, Tensor) else part for name, part in arrays.items()}
        self.arrays[step, number] = columns | {"pieces": parts}

    def sums(self, step: str) -> Iterable[PieceSums]:
        return self.arrays[step, 0]["pieces"]

    def drop(self, *steps: str) -> None:
        for step in steps:
            self.arrays.pop((step, 0), None)

    def writable(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array)

    def keep_directions(self, directions: RegionDirections) -> None:
        self.arrays["directions", None] = {"all": directions}

    def directions(self) -> RegionDirections:
        return self.arrays["directions", None]["all"]

    def new_features(self, piece: int) -> Tensor:
        size = self.splats * self.channels * self.dtype.itemsize
        is_large = self.memory_limit is not None and size > self.memory_limit
        return zeros((self.splats, self.channels), self.dtype, name="features", in_file=is_large)

    def save_features(self, piece: int, X: Tensor) -> None:
        self.arrays["features", 0] = {"X": X}

    def features(self) -> Tensor:
        return self.arrays.pop(("features", 0))["X"]

    def samples(self) -> Sequence[SampledRays]:
        return self.rays


@one_thread()
def scene_of(
    geometry: Geometry,
    means: Tensor,
    settings: LiftSettings,
    names: tuple[str, ...],
    *,
    threads: int | None = None,
    memory_limit: int | None = None,
) -> InMemory:
    """Return W of all views in one piece, before any step.

    Args:
        means: [P, 3], of the splats. names: of the views. memory_limit: bytes of X beyond which it is a mapped file.
    """
    W, book = geometry.weights, geometry.codebook
    scene = InMemory(
        settings=settings, names=names, splats=W.splats.shape[0], channels=book.channels, centres=means,
        vectors=book, rays=geometry.samples, memory_limit=memory_limit,
    )  # fmt: skip
    scene.save("regions", None, {"offsets": W.offsets, "levels": geometry.levels})
    tensors = {"splats": W.splats, "starts": W.indptr, "region": W.region, "weight": W.weight}
    scene.save("weights", 0, tensors)
    scene.save("rows", 0, *row_arrays(scene, W, means, geometry.total_weight(), threads))
    return scene


def weigh_in_memory(
    inputs: LiftInputs,
    plan: Plan,
    on_plan: Callable[[Plan], None],
    timings: Timings,
    threads: int | None,
    checkpoint: Checkpoint | None,
) -> tuple[InMemory, WeightStatistics]:
    """Compute W of the plan's views; call ``on_plan`` once, as soon as contradictions of the inputs are known."""
    splats, views, settings = inputs.splats, inputs.views, inputs.settings
    raster = open_raster(splats, plan.device, threads)
    first, begin = probe_views(len(views)), time.perf_counter()
    plans = [plan]

    def check_first(geometry: Geometry) -> None:
        seconds = time.perf_counter() - begin
        if views.features.paths:
            warnings = contradictions(raster, views, settings, plan.seen_share, geometry)
            plans.append(replace(plan, input_warnings=(*plan.input_warnings, *warnings)))
        if len(views) >= TIMED_VIEWS:
            plans.append(replace(plans[-1], seconds=seconds * len(views) / len(first)))
        on_plan(plans[-1])

    geometry = weigh_views(
        raster, splats.count, views, settings, timings.progress, by_rows=settings.weighs_rows, threads=threads,
        checkpoint=checkpoint.of(splats, plan.device.facts()) if checkpoint else None,
        first=first, on_first=check_first,
    )  # fmt: skip
    scene = scene_of(geometry, splats.means, settings, views.names, threads=threads, memory_limit=plan.features_room)
    return scene, WeightStatistics(plans[-1], geometry.levels, geometry.weights.region.shape[0], geometry.blind)
