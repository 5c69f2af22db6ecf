"""Memory in the plan, compared with the arrays that a lift allocates."""

from __future__ import annotations

import pytest
import torch

import liftcore as lc
from liftcore.lifting.planning.plan import check_memory, features_room
from liftcore.raster.cpu import weights
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.region_weights import MEMORY_LIMIT
from tests.benchmarks.room import room_cameras, room_splats
from tests.scenes import random_camera, random_regions, random_splats

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
    assert {"geometry", "gather", "objects", "reweighting", "solve", "aggregation"} == totals.keys()
    assert "view" not in plan.memory_phases["solve"] and "features" not in plan.memory_phases["geometry"]


def test_clusters_that_are_rendered_are_planned_with_a_view() -> None:
    (camera,) = room_cameras(1, WIDTH, HEIGHT)
    views = {camera.name: DENSE["a region a pixel"]}

    plan = lc.plan(room_splats(300), {camera.name: camera}, views, aggregation=True)
    assert plan.memory_phases["aggregation"]["view"] > 16 * WIDTH * HEIGHT


def test_a_worker_holds_some_views_or_splats() -> None:
    cameras = {camera.name: camera for camera in room_cameras(24, WIDTH, HEIGHT)}
    views = dict(zip(cameras, [DENSE["a region a pixel"]] * 24, strict=True))
    inputs = room_splats(300_000), cameras, views
    whole, worker = (lc.plan(*inputs, in_blocks=in_blocks) for in_blocks in (False, True))
    for name in ("objects", "reweighting"):
        assert worker.memory_phases[name][name] < 0.5 * whole.memory_phases[name][name]
    # W of all views is capped, as more lies in files; of eight views it is not a third of that.
    assert whole.weight_bytes > 3 * MEMORY_LIMIT
    assert worker.memory_phases["geometry"]["weights"] == MEMORY_LIMIT


@pytest.mark.parametrize("threads", [1, 3])
def test_merging_in_parts_changes_no_bit(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    camera, splats = random_camera(1), random_splats(3, 60)
    request = camera, random_regions(1), CompositingParams(), Weighting()
    expected = CpuRaster(splats, threads=1).region_weights(*request)
    monkeypatch.setattr(weights, "RANGE_ENTRIES", 50)
    parts = CpuRaster(splats, threads).region_weights(*request)
    assert expected.region.shape[0] > 100
    for name, tensor in expected.tensors().items():
        assert torch.equal(tensor, parts.tensors()[name]), name
