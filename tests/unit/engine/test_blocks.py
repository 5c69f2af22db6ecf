"""A lift in blocks equals the lift: bitwise identical with one group of views, in any order and on any worker."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.lifting import pipeline
from liftcore.lifting.engines import LocalEngine, blocks
from liftcore.lifting.planning.plan import Plan
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings
from tests.promises.scenes import ShuffledEngine, arrays_of, look_at, random_grid, regions_of
from tests.scenes import random_splats

ROWS = 1 << 11  # of a block
COUNT = 2 * ROWS + 500
VIEWS = 10  # two pieces


@pytest.fixture(scope="module")
def scene() -> dict[str, Any]:
    """Return splats that a view sees in part, in three blocks, and views of regions and of grids."""
    rng = np.random.default_rng(1)
    splats = random_splats(3, COUNT, spread=6.0)
    splats = replace(splats, means=splats.means * torch.tensor([1.0, 1.0, 0.05]))  # a sheet: views see the same
    cameras = {f"v{number}": look_at(rng.normal((0, 0, -4), 1), f"v{number}") for number in range(VIEWS)}
    views = {
        name: regions_of(camera, rng) if number % 2 else random_grid(rng)
        for number, (name, camera) in enumerate(cameras.items())
    }
    return {"splats": splats, "cameras": lc.Cameras(cameras), "views": views}


def in_blocks(
    engine: Any, scene: dict[str, Any], settings: LiftSettings, folder: Path | None = None, progress: Any = None
) -> lc.LiftResult:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("liftcore.lifting.engines.folder.ROWS", ROWS)
        patch.setattr("liftcore.lifting.engines.folder.SELECTED", 1000)
        return lc.lift(**scene, preset=settings, engine=engine, checkpoint=folder, progress=progress)


def assert_same(left: lc.LiftResult, right: lc.LiftResult) -> None:
    assert arrays_of(left) == arrays_of(right)


def test_lift_goes_on_from_the_pieces_in_its_folder(scene: dict[str, Any], tmp_path: Path) -> None:
    write_pack(tmp_path / "pack.safetensors", scene["views"], {"text_space": "words"})
    stored = {**scene, "views": lc.read_features(tmp_path / "pack.safetensors")}
    folder, settings = tmp_path / "work", LiftSettings.of(preset="tikhonov", smoothness=1)

    def stop(stage: str, completed: int, total: int, unit: str) -> None:
        if (stage, completed) == ("solve", 1):
            raise InterruptedError

    with pytest.raises(InterruptedError):
        in_blocks(LocalEngine(1), stored, settings, folder=folder, progress=stop)
    write_times = {path: path.stat().st_mtime_ns for path in folder.rglob("*-0000?.safetensors")}
    assert len(write_times) >= VIEWS + 3
    draft = next(iter(write_times)).with_name(".columns-00001.safetensors.0123abcd.part")
    draft.touch()  # of a worker that was killed
    result = in_blocks(LocalEngine(1), stored, settings, folder=folder)
    assert {path: path.stat().st_mtime_ns for path in write_times} == write_times
    assert result.metadata.text_space == "words" and not draft.exists()
    assert_same(result, in_blocks(LocalEngine(1), scene, settings))
    assert_same(result, in_blocks(LocalEngine(1), stored, settings, folder=folder))  # smooth once, not twice


def test_folder_that_is_full_or_that_workers_do_not_see_is_named(scene: dict[str, Any], tmp_path: Path) -> None:
    class Full(LocalEngine):
        def run(self, work: Any, pieces: Any, count: int) -> Iterator[int]:
            raise OSError(errno.ENOSPC, "No space left on device")

    class RemoteEngine(LocalEngine):
        def run(self, work: Any, pieces: Any, count: int) -> Iterator[int]:
            (pieces.folder / blocks.SCENE).unlink()
            return super().run(work, pieces, count)

    for engine, message in (
        (Full(1), "room for blocks in .*No space left"),
        (RemoteEngine(1), "under one path.*scene"),
    ):
        with pytest.raises(lc.Unavailable, match=message):
            in_blocks(engine, scene, LiftSettings.of(preset="row-sum"), folder=tmp_path)


def test_folder_without_room_for_the_blocks_is_refused_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = {name: look_at(np.array([0, 0, -4.0]), name) for name in ("v0", "v1", "v2")}
    plans = list[Plan]()
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1))
    result = lc.lift(
        random_splats(3, 300), cameras, few_views(1), "row-sum", engine=LocalEngine(1), on_plan=plans.append
    )
    assert any("GiB of disk: give a checkpoint folder" in warning for warning in plans[0].warnings)
    assert not any("of disk" in warning for warning in result.diagnostics["warnings"])  # of this machine, today


def test_plan_in_blocks_is_of_a_worker_and_asks_this_machine_for_no_room(
    scene: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pipeline.plan(**scene, preset="row-sum")
    monkeypatch.setattr("liftcore.lifting.planning.plan.free_memory", lambda: 1)
    with pytest.raises(lc.Unavailable, match="memory"):
        pipeline.plan(**scene, preset="row-sum")
    worker = pipeline.plan(**scene, preset="row-sum", in_blocks=True)
    weights = [plan.memory_phases["geometry"]["weights"] for plan in (worker, expected)]
    assert worker.views == expected.views and weights[0] < weights[1]
    assert worker.in_files == 0


def few_views(seed: int) -> dict[str, lc.FeatureGrid]:
    rng = np.random.default_rng(seed)
    return {f"v{k}": lc.FeatureGrid(rng.normal(0, 1, (6, 8, 4)).astype(np.float32)) for k in range(3)}


@pytest.mark.slow
def test_other_engines_go_on_from_the_pieces_of_each_stage(scene: dict[str, Any], tmp_path: Path) -> None:
    write_pack(tmp_path / "pack.safetensors", scene["views"], {})
    stored = {**scene, "views": lc.read_features(tmp_path / "pack.safetensors")}
    folder, settings = tmp_path / "work", LiftSettings.of(preset="default")
    stopped_stages = []
    for number, stage in enumerate(("geometry", "gather", "objects", "consensus", "reweight", "solve")):

        def stop(name: str, completed: int, total: int, unit: str, at: str = stage) -> None:
            if name == at and completed >= 1:
                stopped_stages.append(at)
                raise InterruptedError

        with pytest.raises(InterruptedError):
            in_blocks((LocalEngine(1), ShuffledEngine(2))[number % 2], stored, settings, folder=folder, progress=stop)
    assert stopped_stages == ["geometry", "gather", "objects", "consensus", "reweight", "solve"]
    result = in_blocks(ShuffledEngine(2), stored, settings, folder=folder)
    expected = lc.lift(**scene, preset=settings)
    assert_same(result, expected)
    assert result.diagnostics["reweighting"] == pytest.approx(expected.diagnostics["reweighting"], rel=1e-12)
