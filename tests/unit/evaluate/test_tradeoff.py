"""Speed against accuracy: what is compared with what, which run is taken, and what is left behind."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save, save_file

from liftcore import cli
from liftcore.errors import InvalidInput
from liftcore.evaluate import tradeoff as comparison
from liftcore.evaluate import tradeoff_report as report
from liftcore.evaluate.accuracy import cosine_figures
from liftcore.evaluate.tradeoff import CANDIDATES, RunSpec, Scene, choose, measured, pareto
from liftcore.evaluate.tradeoff_report import table_of
from liftcore.progress import silent
from tests.unit.solve.test_lift_equals_dense import write_scene

pytestmark = pytest.mark.slow


def run_of(name: str, seconds: float, accuracy: float, kind: str = "dial") -> dict:
    names = ("cosine", "cosine_plain", "cosine_q05", "held_out_cosine")
    figures = dict.fromkeys(names, accuracy) | {"mask_iou": None, "peak_memory_bytes": 1 << 30, "views": 3}
    times = {f"{part}{end}": seconds for part in ("wall", "cpu") for end in ("_s", "_ratio")}
    return {"name": name, "kind": kind, "options": {"speed": name}, **figures, **times}


RUNS = [
    run_of("exact", 10, 0.95),
    run_of("fast", 2, 0.945),
    run_of("draft", 1, 0.9),
    run_of("slow", 12, 0.9, "preset"),
]


def test_the_fastest_run_near_the_best_is_taken():
    assert pareto(RUNS, "held_out_cosine") == ["draft", "fast", "exact"]
    choice = choose(RUNS)
    assert (choice["name"], choice["accuracy"]) == ("fast", "held_out_cosine")
    assert "within 1% of the best (exact, 0.9500)" in choice["why"]
    alone = choose([run_of("exact", 10, 0.95), run_of("fast", 2, 0.93)])
    assert alone["name"] == "exact"
    best = "exact has the best held-out view cosine (0.9500), and none within 1% of it takes less than its 10.00 s"
    assert alone["why"].startswith(best) and "against" not in alone["why"]
    assert choose([run | {"mask_iou": 0.5} for run in RUNS])["accuracy"] == "mask_iou"


def test_cosines_count_splats_that_the_exact_run_saw():
    exact = torch.tensor([[1.0, 0], [0, 1], [1, 0], [0, 0]])
    found = cosine_figures(
        torch.tensor([[2.0, 0], [0, 0], [0, 1], [1, 1]]), exact, torch.tensor([3.0, 0.5, 0.5, 9.0])
    )
    assert found["cosine"] == pytest.approx(3 / 4)
    assert found["cosine_plain"] == pytest.approx(1 / 3)
    assert found["cosine_q05"] == 0


def order_of(folder: Path, **parts) -> RunSpec:
    paths = write_scene(folder, 2)
    scene = Scene(paths[0], paths[1], (paths[2],), **parts)
    return RunSpec(scene, {"certificate_rays": 0}, ("v0", "v1"), ("v2",), (), 1, folder, exact=True)


def test_a_run_is_judged_by_views_that_it_did_not_lift(tmp_path):
    order = order_of(tmp_path)
    exact = measured(order)
    assert (exact["views"], exact["mask_iou"]) == (2, None)
    assert [exact["cosine"], exact["cosine_plain"]] == pytest.approx([1.0, 1.0])
    assert -1 < exact["held_out_cosine"] < 1
    assert exact["peak_memory_bytes"] > 1 << 26
    assert exact["cpu_with_reading_s"] > exact["cpu_s"] > 0
    other = measured(replace(order, settings={"speed": "draft"}, exact=False))
    assert other["cosine"] < 1
    again = measured(replace(order, lifted=("v0", "v1", "v2"), settings={}, exact=False))
    assert again["held_out_cosine"] > exact["held_out_cosine"]  # the view was lifted


def test_masks_are_judged_by_the_words_of_their_classes(tmp_path):
    vectors = torch.nn.functional.normalize(torch.randn(2, 6, generator=torch.Generator().manual_seed(0)), dim=1)
    save_file({"embeddings": vectors}, tmp_path / "t", metadata={"words": '["cat", "dog"]'})
    masks = {"v2/mask": torch.zeros(7, 9, dtype=torch.int16), "other": torch.zeros(1)}
    save_file(masks, tmp_path / "m")
    files = {"labels": tmp_path / "m", "table": tmp_path / "t"}
    figures = []
    for classes in (("cat", "dog"), ("dog", "cat")):
        order = order_of(tmp_path, classes=classes, **files)
        figures.append(measured(replace(order, labelled=("v2",)))["mask_iou"])
    # A mask of zeros: the share of its pixels called "cat" over all, then "dog"; the other class has an IoU of zero.
    assert figures[0] + figures[1] == pytest.approx(0.5, abs=0.01)


def test_a_short_budget_takes_fewer_views_and_runs_the_exact_one_alone(tmp_path, monkeypatch):
    calls = []

    def told(order, candidate):
        calls.append((candidate.name, order.lifted))
        return {
            **run_of(candidate.name, 10, 0.9),
            "process_s": 10.0,
            "wall_with_reading_s": 11,
            "cpu_with_reading_s": 9,
        }

    monkeypatch.setattr(comparison, "_run", told)
    monkeypatch.setattr(comparison, "LEAST_VIEWS", 1)
    paths = write_scene(tmp_path, 2)
    scene = Scene(paths[0], paths[1], (paths[2],))
    found = comparison.compare(scene, 1.0, {}, 1, silent)
    assert [name for name, _ in calls] == ["draft", "exact"]
    assert [run["name"] for run in found["runs"]] == ["exact"]
    assert found["skipped"] == [candidate.name for candidate in CANDIDATES[1:]]
    assert (found["views"], calls[1][1]) == ({"lifted": 1, "of": 2, "held_out": 1}, ("v0",))
    calls.clear()
    found = comparison.compare(scene, 1e6, {}, 1, silent)
    assert (len(found["runs"]), found["skipped"], found["views"]["lifted"]) == (len(CANDIDATES), [], 2)


def test_chart_table_and_json_are_written(tmp_path):
    document = {
        "title": "t", "scene": "s", "command": "c", "runs": RUNS, "skipped": ["mean"], "choice": choose(RUNS),
        "views": {"lifted": 2, "of": 4, "held_out": 1}, "labelled_views": 0, "budget_s": 1.0, "seconds": 2.0,
        "date": "2026-11-21", "hardware": {"cpu": "x"},
    }  # fmt: skip
    paths = report.save(document, tmp_path / "out")
    assert [path.name for path in paths] == ["tradeoff.json", "tradeoff.png", "tradeoff.md"]
    assert json.loads(paths[0].read_text())["choice"]["name"] == "fast"
    assert paths[1].read_bytes()[:4] == b"\x89PNG"
    page = paths[2].read_text()
    assert "**Take fast**" in page
    assert "every n-th of 4" in page
    assert "Not run for want of time: mean." in page
    assert [line.split(" | ")[0] for line in table_of(document)[2:]] == [
        "| **draft**", "| **fast**", "| **exact**", "| slow",
    ]  # fmt: skip


def test_command_compares_in_processes_of_their_own(tmp_path, capsys):
    paths = write_scene(tmp_path, 2)
    command = ["tradeoff", *map(str, paths), "--budget", "0.1", "-o", str(tmp_path / "out"), "--json"]
    assert cli.main([*command, "--set", "certificate_rays=0", "--threads", "1"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [run["name"] for run in document["runs"]] == ["exact"]
    assert document["runs"][0]["cosine"] == pytest.approx(1.0)
    assert all(Path(file).is_file() for file in document["files"])
    assert np.isfinite(document["runs"][0]["wall_with_reading_ratio"])
    again = vars(cli.build_parser().parse_args(shlex.split(document["command"])[1:]))
    given = vars(cli.build_parser().parse_args([*command, "--set", "certificate_rays=0", "--threads", "1"]))
    assert {key for key, value in given.items() if again[key] != value} == {"out", "json"}


@pytest.mark.parametrize("wrong", [["--set", "speed=fast"], ["--set", "stride=0"], ["--labels", "nowhere"]])
def test_bad_orders_are_refused_in_one_line(tmp_path, capsys, wrong):
    paths = write_scene(tmp_path, 2)
    assert cli.main(["tradeoff", *map(str, paths), "-o", str(tmp_path / "out"), *wrong]) == 2
    assert capsys.readouterr().err.count("\n") == 1


BAD_MASKS = {
    "nothing there": None,
    "foreign": b"hello, world",
    "truncated": save({"v2/mask": torch.zeros(7, 9, dtype=torch.int16)})[:-5],
    "three sides": save({"v2/mask": torch.zeros(1, 7, 9, dtype=torch.int16)}),
    "fractions": save({"v2/mask": torch.zeros(7, 9)}),
    "empty": save({"v2/mask": torch.zeros(0, 9, dtype=torch.int16)}),
    "no such class": save({"v2/mask": torch.full((7, 9), 2, dtype=torch.uint8)}),
    "below none": save({"v2/mask": torch.full((7, 9), -2, dtype=torch.int8)}),
}


@pytest.mark.parametrize("masks", BAD_MASKS.values(), ids=BAD_MASKS)
def test_bad_masks_are_refused_in_one_line(tmp_path, capsys, masks):
    paths = write_scene(tmp_path, 2)
    save_file({"embeddings": torch.eye(2, 6)}, tmp_path / "t", metadata={"words": '["cat", "dog"]'})
    if masks is not None:
        (tmp_path / "m").write_bytes(masks)
    words = ["--labels", str(tmp_path / "m"), "--table", str(tmp_path / "t"), "--classes", "cat", "dog"]
    assert cli.main(["tradeoff", *map(str, paths), "-o", str(tmp_path / "out"), *words]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "labels" in told


def test_a_table_of_other_channels_is_refused_in_one_line(tmp_path, capsys):
    paths = write_scene(tmp_path, 2)
    save_file({"embeddings": torch.eye(2, 5)}, tmp_path / "t", metadata={"words": '["cat", "dog"]'})
    save_file({"v2/mask": torch.zeros(7, 9, dtype=torch.int16)}, tmp_path / "m")
    words = ["--labels", str(tmp_path / "m"), "--table", str(tmp_path / "t"), "--classes", "cat", "dog"]
    assert cli.main(["tradeoff", *map(str, paths), "-o", str(tmp_path / "out"), *words]) == 2
    assert capsys.readouterr().err == "splatlift: table: expected 6 channels, as the features, got 5\n"


def test_a_scene_of_which_the_exact_run_sees_nothing_is_refused(tmp_path, monkeypatch):
    blind = cosine_figures(torch.zeros(3, 2), torch.zeros(3, 2), torch.ones(3))
    assert set(blind.values()) == {None}
    monkeypatch.setattr(comparison, "_run", lambda *_: run_of("exact", 10, 0.9) | {"process_s": 1.0} | blind)
    paths = write_scene(tmp_path, 2)
    with pytest.raises(InvalidInput, match="gave no splat a feature"):
        comparison.compare(Scene(paths[0], paths[1], (paths[2],)), 1.0, {}, 1, silent)


def test_what_is_no_number_is_the_worst_accuracy():
    assert choose([run_of("exact", 10, float("nan")), run_of("fast", 2, 0.5)])["name"] == "fast"
    assert choose([run_of("exact", 10, float("nan"))])["name"] == "exact"


def test_every_nth_view_is_compared_when_the_settings_say_so(tmp_path, monkeypatch):
    orders = []

    def told(order, candidate):
        orders.append(order)
        times = dict.fromkeys(("process_s", "wall_with_reading_s", "cpu_with_reading_s"), 1e6)
        figures = run_of(candidate.name, 10, 0.9) | times
        del figures["options"]  # a run does not tell them
        return figures

    monkeypatch.setattr(comparison, "_run", told)
    paths = write_scene(tmp_path, 2)
    scene = Scene(paths[0], paths[1], (paths[2],))
    found = comparison.compare(scene, 1e5, {"view_stride": 2}, 1, silent)
    assert (orders[-1].lifted, orders[-1].held_out) == (("v0",), ("v2",))
    assert measured(replace(orders[-1], reference=tmp_path))["views"] == 1
    assert found["runs"][0]["options"]["view_stride"] == 2
