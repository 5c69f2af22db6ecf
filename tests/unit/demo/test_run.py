"""The demo end to end: the shipped scene through the real service, in a process of its own."""

import argparse
import json
from pathlib import Path

import pytest
from PIL import Image

from liftcore.errors import Unavailable
from liftcore.query.result import load_lift
from liftcore.text import LVIS_TABLE
from service.commands import demo
from service.commands.demo import SHIPPED

pytestmark = pytest.mark.slow


def test_the_demo_finds_what_it_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert demo.run(argparse.Namespace(out=tmp_path, json=True, ask=["penguin", "sofa"])) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["splats"], report["channels"], report["views"]) == (166_000, 512, 18)
    penguin, sofa = report["phrases"]
    assert (penguin["present"], sofa["present"], sofa["iou"]) == (True, False, None)
    assert penguin["iou"] > 0.8 and 0.2 < penguin["threshold"] < 0.4  # cosines as photos have them
    assert load_lift(Path(report["lift_file"])).features.shape[0] == report["splats"]
    phrase_pictures = [name for phrase in report["phrases"] for name in phrase["pictures"].values()]
    assert len(phrase_pictures) == 4
    for name in (report["picture"], *phrase_pictures):
        with Image.open(tmp_path / name) as picture:
            assert picture.size == (640, 480) and picture.getextrema() != ((0, 0),) * 3


def test_shipped_scene_is_small_and_names_its_sources() -> None:
    files = [*SHIPPED.iterdir(), LVIS_TABLE]
    assert sum(file.stat().st_size for file in files) < 8_000_000
    licences = (SHIPPED / "LICENCES.md").read_text(encoding="utf-8")
    for entry in json.loads((SHIPPED / "truth.json").read_text())["objects"]:
        licence = entry["license"].removeprefix("procedural, ").casefold()
        assert any(entry["class"] in line and licence in line.casefold() for line in licences.splitlines()), entry


def test_service_that_does_not_start_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(Unavailable, match=r"an early end; its last words: .*a directory to read and write"),
        demo.serving(tmp_path / "log", tmp_path / "log"),  # a file in place of the directory
    ):
        raise AssertionError
