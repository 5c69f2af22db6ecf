"""The steps of a view are timed without changing what is computed, and no second is counted twice."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import TYPE_CHECKING

import torch

from liftcore import cli
from liftcore.evaluate import stages
from liftcore.evaluate.stages import STAGES, Clock, TimedRaster
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from tests.benchmarks.peers.work import Size, room

if TYPE_CHECKING:
    import pytest


def test_a_stage_within_a_stage_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 1.0, 3.0, 10.0])
    monkeypatch.setattr(stages.time, "perf_counter", lambda: next(ticks))
    clock = Clock()
    with clock.stage("outer"), clock.stage("inner"):
        pass
    assert clock.wall == {"inner": 2.0, "outer": 8.0}


def test_the_timed_raster_gives_the_same_weights_and_names_every_step() -> None:
    work = room(Size(splats=2_000, width=64, height=48, views=1, channels=2), threads=1)
    raster = TimedRaster(work.splats)
    timed = raster.region_weights(*work.views[0], CompositingParams(), Weighting())
    plain = CpuRaster(work.splats, threads=2).region_weights(*work.views[0], CompositingParams(), Weighting())
    assert all(torch.equal(getattr(timed, field.name), getattr(plain, field.name)) for field in fields(timed))
    assert set(raster.clock.wall) == set(STAGES) - {"rest", "solution"}
    assert all(seconds > 0 for seconds in raster.clock.wall.values())


def test_bench_prints_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["bench", "--stages", "--splats", "2000", "--size", "64x48", "--views", "2", "--channels", "8"]
    assert cli.main([*small, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["presets"]
    assert set(found) == {"row-sum", "tikhonov"}
    for preset in found.values():
        assert tuple(preset["stages"]) == STAGES
        assert all(figures["wall_s"] >= figures["wall_s_min"] > 0 for figures in preset["stages"].values())
    assert cli.main(small) == 0
    lines = capsys.readouterr().out
    assert all(f"  {name} " in lines for name in STAGES)
