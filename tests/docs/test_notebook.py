"""The notebook runs from its first cell to its last, and what is saved in it is what its cells say."""

import json
from typing import Any

import matplotlib
import pytest
from matplotlib import pyplot

from liftcore.demo.scene_folder import find_scene

from .readme import ROOT

NOTEBOOK = ROOT / "docs" / "quickstart.ipynb"
CELLS = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def test_cells_run_in_order_and_print_what_is_saved(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    matplotlib.use("Agg")
    monkeypatch.setattr(pyplot, "show", lambda: None)
    names: dict[str, Any] = {}
    for cell in CELLS:
        exec(compile("".join(cell["source"]), str(NOTEBOOK), "exec"), names)
        saved = "".join("".join(output.get("text", [])) for output in cell["outputs"])
        assert capsys.readouterr().out.splitlines()[:1] == saved.splitlines()[:1]
        pictures = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
        assert len(pictures) == len(pyplot.get_fignums())
        pyplot.close("all")
    scene = find_scene(names["folder"], (), names["folder"])
    assert scene.truth is not None
    mask, truth = names["mask"], scene.truth.mask_of(names["phrase"], "view_030")
    assert (mask & truth).sum() / (mask | truth).sum() > 0.8


def test_notebook_is_small_and_its_cells_ran_in_order() -> None:
    assert NOTEBOOK.stat().st_size < 400_000
    assert [cell["execution_count"] for cell in CELLS] == list(range(1, len(CELLS) + 1))
