"""The plan's region weights on real maps: regions in tuples and in rows, and cells, coarse and fine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import FeatureGrid
from liftcore.io.scene_files import lift_files
from liftcore.planning.plan import ENTRY_BYTES
from liftcore.settings import LiftSettings

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


def told(scene: Path, pack: Path, own: dict[str, Any]) -> tuple[float, float]:
    """Bytes of W that the plan expects, and those of the entries that the lift made."""
    settings = LiftSettings.of(**own, certificate_rays=100, device="cpu")
    certificate = lift_files(scene / "point_cloud.ply", scene / "cameras.json", [pack], settings).metadata.certificate
    plan = certificate["plan"]
    return plan["memory"]["weights"], ENTRY_BYTES * certificate["weights_entries"]


# The most that a plan may be above what is found: the more levels a view has, the fewer of its regions a splat meets.
@pytest.mark.parametrize(
    ("name", "own", "most"),
    [
        ("features", {"view_stride": 6}, 9),
        ("features", {"view_stride": 6, "robust_steps": 1}, 7),
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
