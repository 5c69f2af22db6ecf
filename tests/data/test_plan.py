"""The plan's region weights on real maps: regions in tuples and in rows, and cells, coarse and fine."""

from __future__ import annotations

import tracemalloc
from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore.lifting import in_memory
from liftcore.lifting.files import lift_files
from liftcore.lifting.planning.plan import ENTRY_BYTES
from liftcore.solve import reweight
from liftcore.values.pack import read_features, write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid

if TYPE_CHECKING:
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


def certified(scene: Path, pack: Path, own: dict[str, Any]) -> dict[str, Any]:
    """The diagnostics of a lift."""
    settings = LiftSettings.of(**{"preset": "row-sum"} | own, diagnostic_rays=100, device="cpu")
    return lift_files(scene / "point_cloud.ply", scene / "cameras.json", [pack], settings).metadata.diagnostics


def told(scene: Path, pack: Path, own: dict[str, Any]) -> tuple[float, float]:
    """Bytes of W that the plan expects, and those of the entries that the lift made."""
    diagnostics = certified(scene, pack, own)
    plan = diagnostics["plan"]
    return plan["memory"]["weights"], ENTRY_BYTES * diagnostics["weights_entries"]


# The most that a plan may be above what is found: the more levels a view has, the fewer of its regions a splat meets.
@pytest.mark.parametrize(
    ("name", "own", "most"),
    [
        ("features", {"view_stride": 6}, 9),
        ("features", {"view_stride": 6, "levels": 0}, 7),
        ("grids", {"view_stride": 6}, 4),
        ("grids", {"view_stride": 6, "grid_reading": "nearest"}, 9),
        ("grids", {"view_stride": 6, "stride": 3}, 5),
    ],
)
def test_plan_has_room_for_the_region_weights_there_will_be(shared_data, name, own, most):
    """An upper bound: a splat meets a region or four cells in each tile and level that it touches."""
    scene = shared_data / "tabletop"
    planned, found = told(scene, scene / f"{name}.safetensors", own)
    assert found < planned < most * found


@pytest.mark.parametrize(("reading", "most"), [("bilinear", 1.4), ("nearest", 2.5)])
def test_fine_maps_are_planned_with_their_many_weights(shared_data, fine_maps, reading, most):
    planned, found = told(shared_data / "tabletop", fine_maps, {"grid_reading": reading})
    assert found < planned < most * found


def test_plan_has_room_for_what_reweighting_holds(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held, made = [], (reweight.zeros, in_memory.mask_consensus)

    def array(*arguments: Any, **own: Any) -> torch.Tensor:
        held.append(made[0](*arguments, **own))
        return held[-1]

    def consensus(*arguments: Any, **own: Any) -> Any:
        tracemalloc.start()
        found = made[1](*arguments, **own)
        held.append(torch.empty(tracemalloc.get_traced_memory()[1], dtype=torch.uint8))
        tracemalloc.stop()
        return found

    monkeypatch.setattr(reweight, "zeros", array)
    monkeypatch.setattr(in_memory, "mask_consensus", consensus)
    scene, own = shared_data / "tabletop", {"view_stride": 6, "preset": "default"}
    planned = certified(scene, scene / "features_hard.safetensors", own)["plan"]["memory"]["reweighting"]
    assert sum(part.nbytes for part in held) < planned
