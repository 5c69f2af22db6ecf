"""The steps of a lift as a protocol, with two implementations that store W and X differently.

`liftcore.lifting.pipeline` has their order. `liftcore.lifting.in_memory` runs them in the memory of one process,
`liftcore.lifting.engines.lift` in blocks of views and of splats.
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

Weights = TypeVar("Weights")  # W of all views, in memory or in files; immutable


@dataclass(frozen=True)
class WeightStatistics:
    """Facts about W before any reweighting."""

    plan: Plan  # with the warnings and the time that the first views gave
    levels: np.ndarray  # [M] i8, of each region in its view; -1: a cell of a grid, or regions that are tuples
    entries: int  # of W
    blind: tuple[str, ...]  # views whose rays hit no splat

    @property
    def masks(self) -> bool:
        """True if any view has masks."""
        return bool((self.levels >= 0).any())


@dataclass(frozen=True)
class SplatSupport:
    """Weights and confidence behind X, a value a splat."""

    sums: np.ndarray  # [P] f64, of rows of W before any reweighting
    total_weight: Tensor  # [P] f32, sums of plain weights over all views, each ray once
    confidence: Tensor | None  # [P] f32; None where W was not reweighted


class LiftSteps(Protocol[Weights]):
    """The steps of a lift. A step may overwrite the X that it receives, and returns the new one."""

    def plan(self, views: LiftViews, device: Device) -> Plan:
        """Plan the lift of these views; the plan may leave views out, or choose another device."""
        ...

    def weigh(
        self, views: LiftViews, plan: Plan, on_plan: Callable[[Plan], None]
    ) -> tuple[Weights, WeightStatistics]:
        """Compute W of the plan's views; call ``on_plan`` once, as soon as contradictions of the inputs are known."""
        ...

    def find_objects(self, W: Weights) -> RegionObjects:
        """Group splats into objects that the masks of many views agree on, and objects into parts."""
        ...

    def node_vectors(self, W: Weights, objects: RegionObjects) -> NodeVectors:
        """Return the mean feature of each node's masks, before W is reweighted."""
        ...

    def compare_masks(self, W: Weights) -> Weights:
        """Add the consensus of masks to W, for `reweight`."""
        ...

    def reweight(self, W: Weights, levels_apart: bool) -> tuple[Weights, float | None]:
        """Reweight W by the robust step; return it and the median reliability of regions, None without masks.

        Args:
            levels_apart: True if regions are compared with those of their own level alone.
        """
        ...

    def solve(self, W: Weights) -> tuple[Tensor, SplatSupport]:
        """Solve for X [P, F] in closed form."""
        ...

    def compare_with_optimum(self, W: Weights, X: Tensor, visible: np.ndarray) -> dict[str, Any]:
        """Compare X of the ``visible`` [P] bool splats with the least-squares optimum."""
        ...

    def smooth(self, W: Weights, X: Tensor, support: SplatSupport) -> tuple[Tensor, dict[str, Any]]:
        """Smooth X over neighbouring splats by the settings; return facts of the smoothing too."""
        ...

    def aggregate(self, W: Weights, X: Tensor) -> tuple[Tensor, Aggregation]:
        """Give splats the features of their clusters."""
        ...

    def measure(self, W: Weights, X: Tensor) -> ViewMeasures:
        """Measure X on the sampled rays of all views."""
        ...

    def deliver(self, W: Weights, lift: LiftResult) -> LiftResult:
        """Move the lift to where the caller expects it."""
        ...
