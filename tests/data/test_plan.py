"""The plan's entries on real maps: regions in tuples and in rows, and cells, coarse and fine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import FeatureGrid
from liftcore.io.lift_files import lift_files
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    from pathlib import Path

FINE = (120, 160)  # cells: four pixels of tabletop each


@pytest.fixture(scope="module")
def fine_maps(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dense maps of eight views: as many cells as an encoder of small strides makes, of few channels."""
    packs = read_features(shared_data / "tabletop" / "grids.safetensors")
    maps = {view: FeatureGrid(torch.rand(*FINE, 4)) for view in packs.views[:8]}
    path = tmp_path_factory.mktemp("fine") / "fine.safetensors"
    write_pack(path, maps, {})
    return path


def told(scene: Path, pack: Path, own: dict[str, Any]) -> tuple[float, float]:
    """Entries of W that the plan expects of a splat in a view that can see it, and those that the lift made."""
    settings = LiftSettings.of(**own, certificate_rays=100, device="cpu")
    certificate = lift_files(scene / "point_cloud.ply", scene / "cameras.json", [pack], settings).metadata.certificate
    plan = certificate["plan"]
    return plan["entries_a_splat"], certificate["weights_entries"] / plan["views"] / plan["splats_a_view"]


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("features", {"view_stride": 4}),
        ("features", {"view_stride": 4, "robust_steps": 1}),
        ("features", {"view_stride": 4, "levels": 0}),
        ("grids", {}),
        ("grids", {"grid_reading": "nearest"}),
        ("grids", {"stride": 3}),
    ],
)
def test_the_plan_expects_as_many_entries_as_there_will_be(shared_data, name, own):
    scene = shared_data / "tabletop"
    planned, found = told(scene, scene / f"{name}.safetensors", own)
    assert 0.9 * found < planned < 1.8 * found


@pytest.mark.parametrize("reading", ["bilinear", "nearest"])
def test_fine_maps_are_planned_with_their_many_entries(shared_data, fine_maps, reading):
    planned, found = told(shared_data / "tabletop", fine_maps, {"grid_reading": reading})
    assert found > 4.0
    assert 0.9 * found < planned < 1.8 * found
