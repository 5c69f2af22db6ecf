"""The demo and the notebook end to end: the shipped scene, lifted once, by the real service."""

import argparse
import json
import re
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from matplotlib import pyplot
from PIL import Image

import liftcore as lc
from liftcore.errors import Unavailable
from liftcore.text import LVIS_TABLE
from service.commands import demo
from service.commands.demo import SHIPPED, read_truth

pytestmark = pytest.mark.slow
NOTEBOOK = Path(__file__).parents[3] / "docs" / "quickstart.ipynb"
CELLS = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report of the demo, in JSON."""
    out = tmp_path_factory.mktemp("demo")
    with redirect_stdout(StringIO()) as output:
        assert demo.run(argparse.Namespace(out=out, json=True, ask=["penguin", "sofa"])) == 0
    return json.loads(output.getvalue())


def test_the_demo_finds_what_it_asks_for(report: dict[str, Any]) -> None:
    assert (report["splats"], report["channels"], report["views"]) == (166_000, 512, 18)
    penguin, sofa = report["phrases"]
    assert (penguin["present"], sofa["present"], sofa["iou"]) == (True, False, None)
    assert penguin["iou"] > 0.8 and 0.2 < penguin["threshold"] < 0.4  # cosines as photos have them
    assert lc.load_lift(report["lift_file"]).features.shape[0] == report["splats"]
    phrase_pictures = [name for phrase in report["phrases"] for name in phrase["pictures"].values()]
    assert len(phrase_pictures) == 4
    for name in (report["picture"], *phrase_pictures):
        with Image.open(Path(report["out"]) / name) as picture:
            assert picture.size == (640, 480) and picture.getextrema() != ((0, 0),) * 3


def test_cells_run_in_order_and_print_what_is_saved(
    report: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the demo's lift, of the same files and settings, whose splats share rows: numbers differ a little."""
    matplotlib.use("Agg")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(pyplot, "show", lambda: None)
    monkeypatch.setattr(lc, "lift", lambda splats, cameras, views: lc.load_lift(report["lift_file"]))
    names: dict[str, Any] = {}
    for cell in CELLS:
        exec(compile("".join(cell["source"]), str(NOTEBOOK), "exec"), names)
        saved = "".join("".join(output.get("text", [])) for output in cell["outputs"])
        texts = (re.sub(r"\d+", "", text) for text in (capsys.readouterr().out, saved))
        assert next(texts).splitlines()[:1] == next(texts).splitlines()[:1]
        pictures = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
        assert len(pictures) == len(pyplot.get_fignums())
        pyplot.close("all")
    truth = read_truth(names["folder"])
    overlap = truth.mean_iou(names["phrase"], {"view_030": names["mask"]})
    assert overlap is not None and overlap > 0.8


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
