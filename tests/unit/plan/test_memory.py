"""Memory in the plan, compared with the arrays that a lift allocates."""

from __future__ import annotations

import pytest
import torch

import liftcore as lc
from liftcore.lifting.planning.plan import check_memory, features_room
from tests.benchmarks.room import room_cameras, room_splats

WIDTH, HEIGHT, CHANNELS = 416, 320, 2  # 133,120 pixels


def vector_a_pixel(rows: int, columns: int) -> torch.Tensor:
    return torch.rand(rows, columns, CHANNELS, generator=torch.Generator().manual_seed(0))


DENSE = {
    "a vector a pixel": lc.FeatureGrid(vector_a_pixel(HEIGHT, WIDTH)),
    "finer than pixels": lc.FeatureGrid(vector_a_pixel(HEIGHT * 5 // 4, WIDTH * 5 // 4)),
    "a region a pixel": lc.Regions(
        torch.arange(WIDTH * HEIGHT, dtype=torch.int32).reshape(HEIGHT, WIDTH),
        vector_a_pixel(HEIGHT, WIDTH).reshape(-1, CHANNELS),
    ),
}


@pytest.mark.parametrize(("map_of", "stride"), [(map_of, 1) for map_of in DENSE] + [("a vector a pixel", 2)])
def test_plan_says_what_region_weights_of_dense_maps_take(map_of: str, stride: int) -> None:
    (camera,) = room_cameras(1, WIDTH, HEIGHT)
    views = {camera.name: DENSE[map_of]}
    result = lc.lift(room_splats(300), {camera.name: camera}, views, "row-sum", stride=stride, diagnostic_rays=0)
    entry_bytes = 8 * result.diagnostics["weights_entries"]  # four bytes each for the region and the weight
    assert 0.7 < result.metadata.diagnostics["plan"]["memory"]["weights"] / entry_bytes < 2.0


def test_what_one_phase_frees_is_free_for_the_features_of_another() -> None:
    GB = 10**9
    phases = {"geometry": {"libraries": GB, "view": 6 * GB}, "solve": {"libraries": GB, "codebooks": GB}}
    phases["solve"]["features"] = 6 * GB
    assert check_memory(phases, 10 * GB) == [] and features_room(phases, 10 * GB) == 7 * GB
    (features,) = check_memory(phases, 88 * GB // 10)
    assert features.startswith("the features, 5.6 GiB, do not fit")
    (rest,) = check_memory(phases | {"solve": phases["solve"] | {"features": 1}}, 77 * GB // 10)
    assert rest.startswith("the rest of the lift may take 6.5 GiB")


def test_the_peak_of_a_plan_is_that_of_one_phase() -> None:
    (camera,) = room_cameras(1, WIDTH, HEIGHT)
    views = {camera.name: DENSE["a region a pixel"]}
    plan = lc.plan(room_splats(300), {camera.name: camera}, views, aggregation=True)
    totals = {phase: sum(parts.values()) for phase, parts in plan.memory_phases.items()}
    assert plan.memory_bytes == max(totals.values()) == sum(plan.memory.values())
    assert "view" not in plan.memory_phases["solve"] and "features" not in plan.memory_phases["geometry"]
