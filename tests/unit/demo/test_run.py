"""The demo end to end: a small still life through the real service, in a process of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from liftcore.demo.run import run_demo
from liftcore.demo.still_life import still_life
from liftcore.io.lift_file import load_lift


def test_the_demo_finds_what_it_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = still_life(seed=7, views=12, density=0.15)
    phrases = ["something to drink coffee from", "reading light"]
    assert run_demo(None, tmp_path, True, phrases, scene) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["splats"] == scene.splats.count < 10_000 and report["views"] == 12 - len(scene.held_out)
    for found, thing in zip(report["phrases"], ("mug", "lamp"), strict=True):
        assert found["object"] == thing
        assert found["iou"] > 0.7
        assert found["splats"] > 0 and found["threshold"] is not None
    assert load_lift(Path(report["lift_file"])).features.shape[0] == scene.splats.count
    names = [
        *report["pictures"].values(),
        *(name for found in report["phrases"] for name in found["pictures"].values()),
    ]
    assert len(names) == 8
    for name in names:
        with Image.open(tmp_path / name) as picture:
            assert picture.size == (480, 360) and picture.getextrema() != ((0, 0),) * 3
