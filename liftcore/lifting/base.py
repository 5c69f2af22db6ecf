"""The steps of a lift as a protocol: who holds W and X, and where a block of them is worked on.

`liftcore.lifting.pipeline` has their order. In one process's memory they are `liftcore.lifting.in_memory`; an engine
takes them in blocks of views and of splats (`liftcore.lifting.engines.lift`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from liftcore.lifting.planning.plan import Plan
    from liftcore.query.result import LiftResult
    from liftcore.runtime.device import Device
    from liftcore.solve.aggregate import Aggregation
    from liftcore.solve.diagnostics import ViewMeasures
    from liftcore.solve.objects import NodeVectors, RegionObjects
    from liftcore.values.lift_views import LiftViews

Weights = TypeVar("Weights")  # W of all views, wherever it lies; a value that no step changes


@dataclass(frozen=True)
class WeightStatistics:
    """W in numbers, as the views were weighed."""

    plan: Plan  # as the first views correct it
    levels: np.ndarray  # [M] i8, of each region in its view; -1: a cell of a grid, or regions that are tuples
    entries: int  # of W
    blind: tuple[str, ...]  # views that meet no splat

    @property
    def masks(self) -> bool:
        """Whether any view has masks."""
        return bool((self.levels >= 0).any())


@dataclass(frozen=True)
class SplatSupport:
    """What supports X, a value a splat."""

    sums: np.ndarray  # [P] f64, of rows of W as it was weighed
    evidence: Tensor  # [P] f32, sums of plain weights over all views, each ray once
    agreement: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows
    confidence: Tensor | None  # [P] f32; None where W was not reweighted


class LiftSteps(Protocol[Weights]):
    """The steps of a lift. Each returns what it finds; an X that a step takes is given up to it."""

    def plan(self, views: LiftViews, device: Device) -> Plan:
        """Plan the lift of these views, which may leave some out and take another device."""
        ...

    def weigh(
        self, views: LiftViews, plan: Plan, on_plan: Callable[[Plan], None]
    ) -> tuple[Weights, WeightStatistics]:
        """W of the views that the plan leaves; ``on_plan`` is called once, as early as contradictions are known."""
        ...

    def find_objects(self, W: Weights) -> RegionObjects:
        """Find what masks of many views keep together, and the parts of it."""
        ...

    def node_vectors(self, W: Weights, objects: RegionObjects) -> NodeVectors:
        """What the masks of each node say, before W is reweighted."""
        ...

    def compare_masks(self, W: Weights) -> Weights:
        """W with the consensus of masks, for `reweight`."""
        ...

    def reweight(self, W: Weights, levels_apart: bool) -> tuple[Weights, float | None]:
        """W after the robust steps, and the median reliability of regions; None where it is not asked for.

        Args:
            levels_apart: whether regions are compared with those of their own level alone.
        """
        ...

    def discount_distance(self, W: Weights) -> Weights:
        """W with the factors of Huber's loss."""
        ...

    def solve(self, W: Weights, clusters: RegionObjects | None) -> tuple[Tensor, SplatSupport]:
        """X [P, F] in closed form, and what supports it; `aggregate` may take the clusters' features."""
        ...

    def refine(self, W: Weights, X: Tensor, seen: np.ndarray) -> tuple[Tensor, dict[str, Any]]:
        """X after the least squares of the settings, for the splats seen [P] bool; and what is known of it."""
        ...

    def smooth(self, W: Weights, X: Tensor, support: SplatSupport) -> tuple[Tensor, dict[str, Any]]:
        """X after the smoothness of the settings, for all splats; and what is known of it."""
        ...

    def aggregate(self, W: Weights, X: Tensor, clusters: RegionObjects | None) -> tuple[Tensor, Aggregation]:
        """X with the features of clusters; those of features where no masks make them."""
        ...

    def measure(self, W: Weights, X: Tensor) -> ViewMeasures:
        """The measures of all views' sampled rays."""
        ...

    def deliver(self, W: Weights, lift: LiftResult) -> LiftResult:
        """The lift where its owner expects it."""
        ...
