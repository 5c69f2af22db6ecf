"""A lift that was killed goes on from its last block and gives the same bits as one that was not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from liftcore.lifting.files import lift_files
from liftcore.query.result import LiftResult
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.runtime.device import CPU, Device
from liftcore.values.settings import LiftSettings
from tests.promises.scenes import arrays_of
from tests.scenes import write_scene

pytestmark = pytest.mark.slow


class ProcessKilled(Exception):
    """Stands for what ends a process between two calls."""


@pytest.fixture
def rasterized_views(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of rasterized views, without the warm-up."""
    rasterized: list[str] = []
    rasterize = CpuRaster.region_weights

    def recording(self: CpuRaster, camera: Any, *rest: Any, **keywords: Any) -> Any:
        if camera.name != "warm-up":
            rasterized.append(camera.name)
        return rasterize(self, camera, *rest, **keywords)

    monkeypatch.setattr(CpuRaster, "region_weights", recording)
    # Which may look at some views, coarsely.
    monkeypatch.setattr("liftcore.lifting.in_memory.contradictions", lambda *_: [])
    monkeypatch.setattr("liftcore.lifting.pipeline.choose_device", lambda _: CPU)  # on machines with a GPU too
    return rasterized


def killing(stage: str, at: int) -> Callable[..., None]:
    def progress(now: str, completed: int, total: int, unit: str) -> None:
        if (now, completed) == (stage, at):
            raise ProcessKilled

    return progress


def assert_same(left: LiftResult, right: LiftResult) -> None:
    assert arrays_of(left) == arrays_of(right)
    assert left.metadata.diagnostics == right.metadata.diagnostics


def lifted(scene: tuple[Path, Path, Path], settings: LiftSettings | None = None, **keywords: Any) -> LiftResult:
    return lift_files(scene[0], scene[1], [scene[2]], settings or LiftSettings.of(diagnostic_rays=50), **keywords)


def kill_lift(scene: tuple[Path, Path, Path], stage: str, at: int, **keywords: Any) -> None:
    """A lift that ends after so many steps of a stage."""
    with pytest.raises(ProcessKilled):
        lifted(scene, progress=killing(stage, at), **keywords)


@pytest.mark.parametrize("grids", [False, True])
def test_killed_lift_goes_on_from_its_last_view_to_the_same_bits(
    tmp_path: Path, rasterized_views: list[str], grids: bool
) -> None:
    scene = write_scene(tmp_path, 3, grids)
    uninterrupted = lifted(scene, threads=1)
    rasterized_views.clear()
    checkpoint = tmp_path / "kept"
    for at in (1, 1, 2):
        kill_lift(scene, "geometry", at, threads=1, checkpoint=checkpoint)
    resumed = lifted(scene, threads=1, checkpoint=checkpoint)
    assert rasterized_views == ["v0", "v1", "v2"]  # none twice
    assert_same(uninterrupted, resumed)


def test_checkpoint_of_another_device_is_never_used(
    tmp_path: Path, rasterized_views: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_scene(tmp_path, 5)
    checkpoint = tmp_path / "kept"
    for _ in range(2):
        lifted(scene, LiftSettings.of(device="cpu"), checkpoint=checkpoint)
        assert len(rasterized_views) == 3
    facts = {**CPU.facts(), "name": "another"}
    monkeypatch.setattr(Device, "facts", lambda _: facts)
    result = lifted(scene, LiftSettings.of(device="cpu"), checkpoint=checkpoint)
    assert len(rasterized_views) == 6
    assert result.metadata.diagnostics["device"] == facts


def test_lift_without_room_for_its_checkpoint_goes_on(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, 7)
    (tmp_path / "file").write_bytes(b"")
    full_checkpoint = tmp_path / "file" / "kept"
    assert_same(lifted(scene), lifted(scene, checkpoint=full_checkpoint))
