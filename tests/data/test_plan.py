"""The plan's region weights on real maps: regions in tuples and in rows, and cells, coarse and fine."""

from __future__ import annotations

import tracemalloc
from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore.lifting import steps
from liftcore.lifting.files import lift_files
from liftcore.lifting.planning.plan import ENTRY_BYTES, Plan
from liftcore.solve import reweight
from liftcore.values.pack import read_features, write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FINE = (120, 160)  # cells: four pixels of tabletop each


@pytest.fixture(scope="module")
def fine_maps(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dense maps of four views: as many cells as an encoder of small strides makes, of few channels."""
    packs = read_features(shared_data / "tabletop" / "grids.safetensors")
    maps = {view: FeatureGrid(torch.rand(*FINE, 4)) for view in packs.views[:4]}
    path = tmp_path_factory.mktemp("fine") / "fine.safetensors"
    write_pack(path, maps, {})
    return path


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


def test_fine_maps_are_planned_with_their_many_weights(shared_data, fine_maps):
    planned, measured = planned_and_measured(shared_data / "tabletop", fine_maps, {})
    assert measured < planned < 1.4 * measured


def test_plan_has_room_for_what_reweighting_holds(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays, originals = [], (reweight.zeros, steps.region_shares)

    def array(*arguments: Any, **options: Any) -> torch.Tensor:
        arrays.append(originals[0](*arguments, **options))
        return arrays[-1]

    def consensus(*arguments: Any, **options: Any) -> Any:
        tracemalloc.start()
        result = originals[1](*arguments, **options)
        arrays.append(torch.empty(tracemalloc.get_traced_memory()[1], dtype=torch.uint8))
        tracemalloc.stop()
        return result

    monkeypatch.setattr(reweight, "zeros", array)
    monkeypatch.setattr(steps, "region_shares", consensus)
    scene, options = shared_data / "tabletop", {"view_stride": 6, "preset": "default"}
    plans = list[Plan]()
    certified(scene, scene / "features_hard.safetensors", options, plans.append)
    assert 0 < sum(part.nbytes for part in arrays) < plans[0].memory_phases["reweighting"]["reweighting"]
