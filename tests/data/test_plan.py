"""The plan's region weights on real maps: regions in tuples and in rows, and cells, coarse and fine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from liftcore.lifting.files import lift_files
from liftcore.lifting.planning.plan import ENTRY_BYTES, Plan
from liftcore.values.settings import LiftSettings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def certified(
    scene: Path, pack: Path, options: dict[str, Any], on_plan: Callable[[Plan], None] | None = None
) -> dict[str, Any]:
    """The diagnostics of a lift."""
    settings = LiftSettings.of(**{"preset": "row-sum"} | options, diagnostic_rays=100, device="cpu")
    paths = scene / "point_cloud.ply", scene / "cameras.json", [pack]
    return lift_files(*paths, settings, on_plan=on_plan).metadata.diagnostics


def planned_and_measured(scene: Path, pack: Path, options: dict[str, Any]) -> tuple[float, float]:
    """Bytes of W that the plan expects, and those of the entries that the lift made."""
    diagnostics = certified(scene, pack, options)
    plan = diagnostics["plan"]
    return plan["memory"]["weights"], ENTRY_BYTES * diagnostics["weights_entries"]


# The most that a plan may be above what is found: the more levels a view has, the fewer of its regions a splat meets.
@pytest.mark.parametrize(
    ("name", "options", "limit"),
    [
        ("features", {"view_stride": 6}, 9),
        ("features", {"view_stride": 6, "levels": 0}, 7),
        ("grids", {"view_stride": 6}, 4),
        ("grids", {"view_stride": 6, "stride": 3}, 5),
    ],
)
def test_plan_has_room_for_the_region_weights_there_will_be(shared_data, name, options, limit):
    """An upper bound: a splat meets a region or four cells in each tile and level that it touches."""
    scene = shared_data / "tabletop"
    planned, measured = planned_and_measured(scene, scene / f"{name}.safetensors", options)
    assert measured < planned < limit * measured
