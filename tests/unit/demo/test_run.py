"""The demo end to end: a small still life through the real service, in a process of its own."""

import argparse
import json
from pathlib import Path

import pytest
from PIL import Image

from liftcore.cli import demo
from liftcore.demo import write_scene
from liftcore.demo.still_life import still_life
from liftcore.errors import Unavailable
from liftcore.io.lift_file import load_lift

pytestmark = pytest.mark.slow


def test_the_demo_finds_what_it_asks_for(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = still_life(seed=7, views=12, density=0.15)
    monkeypatch.setattr(write_scene, "still_life", lambda _: scene)
    phrases = ["something to drink coffee from", "reading light"]
    assert demo.run(argparse.Namespace(scene=None, out=tmp_path, json=True, ask=phrases)) == 0
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


def test_service_that_does_not_start_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(Unavailable, match=r"an early end; its last words: .*no-such-table"),
        demo.serving(tmp_path / "data", "table:no-such-table.safetensors", tmp_path / "log"),
    ):
        raise AssertionError
