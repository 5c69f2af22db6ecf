"""Smoothing of a finished lift, without its views and without lifting again."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from liftcore.errors import InvalidLift, InvalidSettings
from liftcore.runtime.memory import free_memory, zeros
from liftcore.runtime.progress import Progress, silent
from liftcore.runtime.torch_modes import default_modes
from liftcore.scene.neighbours import SplatGraph
from liftcore.solve.smooth import smooth
from liftcore.values.settings import LiftSettings

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats
    from liftcore.values.lift import Lift

    AnyLift = TypeVar("AnyLift", bound=Lift)

OF_FEATURES = ("residual", "surrogate", "beta", "bound")  # of the diagnostics: sampled rays against the features
MEMORY_SHARE = 0.5  # of the free memory: larger features are held in a mapped file


@default_modes()
def refine(
    lift: AnyLift, splats: Splats, smoothness: float, progress: Progress = silent, threads: int | None = None
) -> AnyLift:
    """Smooth the features of a lift, as `LiftSettings.smoothness` does during a lift, with the same bits.

    Args:
        lift: of any engine; it is not changed. splats: that were lifted. smoothness: lambda, above zero.
        threads: None takes the cores that this process may use. The result is bitwise identical for any value.

    Returns:
        The lift with other features, on the device of the lift. Settings and diagnostics have the step; measures of
        rays against features are None, as no ray is traced.

    Raises:
        InvalidSplats: other splats than were lifted.
        InvalidSettings: smoothness is zero or out of range.
        InvalidLift: it was smoothed before, or its splats have the features of clusters.
    """
    strength = LiftSettings.of(smoothness=smoothness).smoothness
    if not strength:
        raise InvalidSettings("smoothness", expected="a number above 0", got="0", hint="1 is a good first try")
    lift.require_splats(splats)
    settings = lift.settings
    if settings.smoothness:
        got, hint = f"one of smoothness={settings.smoothness}", "refine the lift it came from"
        raise InvalidLift("lift", expected="a lift without smoothness", got=got, hint=hint)
    if settings.aggregation:
        hint = f"lift again with smoothness={strength:g} beside aggregation: clusters are made of smooth features"
        raise InvalidLift("lift", expected="each splat's own features", got="a lift with aggregation", hint=hint)
    start, place = time.perf_counter(), lift.features.device
    lift = lift.cpu()
    free = free_memory()
    in_file = free is not None and lift.features.nbytes > MEMORY_SHARE * free
    X = zeros(tuple(lift.features.shape), lift.features.dtype, name="features", in_file=in_file).copy_(lift.features)
    graph = SplatGraph.of(splats, threads)
    X, facts = smooth(X, graph, lift.total_weight, lift.confidence, lift.has_feature, strength, progress, threads)
    diagnostics: dict[str, Any] = lift.diagnostics | {"smoothing": facts}
    diagnostics |= {name: None for name in OF_FEATURES if name in diagnostics}
    if "beta" in diagnostics:
        diagnostics["beta"] = {"median": None, "p99": None, "max": None}
    if "warning" in facts:
        diagnostics["warnings"] = [*diagnostics.get("warnings", ()), facts["warning"]]
    changes = {
        "settings": settings.model_copy(update={"smoothness": strength}),
        "diagnostics": diagnostics,
        "timings": lift.metadata.timings | {"smooth": time.perf_counter() - start},
    }
    return replace(lift, features=X, metadata=lift.metadata.model_copy(update=changes)).to(place)
