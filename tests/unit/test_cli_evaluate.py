"""``splatlift evaluate`` on labels in the layouts of LeRF-OVS and 3D-OVS: a correct lift scores near one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from liftcore.evaluate import evaluate_lifts
from tests.labelled_scene import (
    FRAMES,
    LIFTED,
    WORDS,
    isat,
    rectangle,
    write_3d_ovs_labels,
    write_lerf_labels,
    write_lift,
)

from .command_line import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lift and both kinds of labels; tests only read them."""
    path = tmp_path_factory.mktemp("evaluate")
    write_lift(path)
    write_lerf_labels(path)
    write_3d_ovs_labels(path)
    save_file({"embeddings": torch.eye(4)}, str(path / "other.table"), metadata={"words": '["a", "b", "c", "d"]'})
    return path


def evaluate(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    status, out, err = run(capsys, "evaluate", *arguments, "--json")
    assert (status, err) == (0, "")
    return json.loads(out)


def test_a_right_lift_scores_near_one_in_every_protocol_of_lerf_ovs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lift = folder / "kitchen.lift.safetensors"
    document = evaluate(capsys, "lerf-ovs", lift, "--data", folder / "lerf_ovs")
    assert [row["protocol"] for row in document["measured"]] == ["P1", "P2", "P3", "own"]
    for row in document["measured"]:
        assert row["scene"] == "kitchen" and row["frames"] == list(FRAMES) and row["lifted_frames"] == [LIFTED]
        means = row["means"]["all labelled"]
        assert (means["frames"], means["objects"]) == (2, 4)
        assert min(means["object_micro"], means["frame_macro"], means["class_pooled"]) > 0.9
        assert (means["accuracy_25"], means["accuracy_50"]) == (1, 1)
        assert means["localised"] == (None if row["protocol"] in ("P2", "own") else 1)
        assert row["means"]["held out"]["frames"] == 1
        assert {obj["lifted"] for obj in row["objects"] if obj["view"] == LIFTED} == {True}
        assert row["classes"].keys() == {"red apple", "book"}
        mean = document["mean_of_scenes"][row["protocol"]]
        assert mean["all labelled"]["object_micro"] == means["object_micro"]
    assert document["warnings"] == [f"kitchen: 1 of 2 judged frames were lifted: {LIFTED}"]
    assert document["settings"]["threshold"] == "auto"


def test_call_judges_as_the_command_does_whatever_form_its_paths_have(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lift, data, names = folder / "kitchen.lift.safetensors", folder / "lerf_ovs", folder / "held_out.txt"
    names.write_text("frame_00002\n")
    options = ["--data", data, "--protocol", "P2", "--held-out", names, "--encoder", ""]
    document = evaluate(capsys, "lerf-ovs", lift, *options)
    for lifts, form in ((lift, Path), ([lift], str), (f"kitchen={lift}", str)):
        evaluation = evaluate_lifts("lerf-ovs", lifts, form(data), protocols="P2", held_out=form(names))
        assert json.loads(json.dumps(evaluation.document())) == document
        assert any("measured" in line for line in evaluation.lines())


def test_3d_ovs_pools_the_pixels_of_a_class(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = evaluate(capsys, "3d-ovs", folder, "--data", folder / "3d_ovs", "--protocol", "P3", "--threshold", 0.5)
    (row,) = document["measured"]
    assert row["classes"].keys() == {"red apple", "book"}  # the unicorn is nowhere
    for name, pooled in row["classes"].items():
        objects = [obj for obj in row["objects"] if obj["category"] == name]
        assert pooled == sum(t["intersection"] for t in objects) / sum(t["union"] for t in objects) > 0.9
    means = row["means"]["all labelled"]
    assert means["class_pooled"] == pytest.approx(sum(row["classes"].values()) / 2)
    assert means["objects"] == 4
    assert any("unicorn" in warning for warning in document["warnings"])


def test_only_held_out_frames_are_judged_and_lifted_ones_are_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = tmp_path / "held_out.txt"
    arguments = ["lerf-ovs", folder, "--data", folder / "lerf_ovs", "--protocol", "P3", "--held-out", names]
    names.write_text("frame_00002.jpg\n\n")
    document = evaluate(capsys, *arguments)
    (row,) = document["measured"]
    assert (row["frames"], row["lifted_frames"], row["means"].keys()) == (["frame_00002"], [], {"all labelled"})
    assert document["warnings"] == [] and document["settings"]["held_out"] == ["frame_00002"]
    names.write_text("frame_00001\n")
    assert "though the list holds them out" in evaluate(capsys, *arguments)["warnings"][0]
    for content, message in (("frame_9\n", "held-out ones"), ("\n", "none in")):
        names.write_text(content)
        status, out, err = run(capsys, "evaluate", *arguments)
        assert (status, out) == (2, "") and message in err and err.count("\n") == 1


def test_categories_that_a_table_lacks_are_left_out_and_none_at_all_are_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = load_file(folder / "words.safetensors")["embeddings"]
    few, lift = tmp_path / "few.safetensors", folder / "kitchen.lift.safetensors"
    save_file({"embeddings": table[1:2].clone()}, str(few), metadata={"words": json.dumps(WORDS[1:2])})
    options = ["--data", folder / "lerf_ovs", "--table", few, "--protocol", "P3"]
    document = evaluate(capsys, "lerf-ovs", lift, *options)
    (row,) = document["measured"]
    assert len(row["classes"]) == 1
    assert any("lacks" in warning and "left out" in warning for warning in document["warnings"])
    assert not any(row["scenes"] for row in document["published"])  # kitchen is none of the papers' scenes
    (tmp_path / "frame_00001.json").write_text(json.dumps(isat([("griffin", rectangle(0, 0, 9, 9))])))
    status, _, err = run(capsys, "evaluate", "lerf-ovs", lift, "--data", tmp_path)
    assert status == 2 and "griffin" in err


def test_published_rows_stand_beside_and_never_in_a_mean(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / "lerf_ovs" / "label" / "kitchen", tmp_path / "label" / "ramen")
    lift = f"ramen={folder / 'kitchen.lift.safetensors'}"
    arguments = ["lerf-ovs", lift, "--data", tmp_path, "--protocol", "P3", "--threshold", "0.5"]
    document = evaluate(capsys, *arguments)
    assert {row["dataset"] for row in document["published"]} == {"lerf-ovs"}
    assert all(row["source"] and row["protocol"] and row["scenes"]["ramen"] for row in document["published"])
    assert document["mean_of_scenes"]["P3"]["all labelled"]["object_micro"] > 0.9
    status, out, err = run(capsys, "evaluate", *arguments)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert "teatime" not in lines[0]
    kinds = [line.split()[0] for line in lines[1:]]
    assert set(kinds) == {"measured", "published", "warning:"} and kinds == sorted(kinds)
    measured = [line for line in lines if line.startswith("measured")]
    assert all(" P3 " in line for line in measured)
    published_line = next(line for line in lines if "62.3" in line)
    assert published_line.split()[:5] == ["published", "P3", "mIoU", "62.3", "Splat"]


def test_frames_without_cameras_or_objects_are_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "lerf_ovs"
    shutil.copytree(folder / "lerf_ovs", data)
    labels = data / "label" / "kitchen"
    shutil.copy(labels / "frame_00001.json", labels / "frame_00009.json")
    (labels / "frame_00002.json").write_text(json.dumps(isat([])))
    arguments = ["lerf-ovs", folder, "--data", data, "--protocol", "P2"]
    warnings = evaluate(capsys, *arguments)["warnings"]
    assert any("frame_00009 have labels but no camera" in warning for warning in warnings)
    assert any("frame_00002 have no labelled object" in warning for warning in warnings)
    for name in ("frame_00001", "frame_00002"):
        (labels / f"{name}.json").unlink()
    status, _, err = run(capsys, "evaluate", *arguments)
    assert status == 2 and "frames named like the lift's cameras" in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["nothing.safetensors"], "nothing at"),
        (["{folder}/kitchen.lift.safetensors", "kitchen={folder}/kitchen.lift.safetensors"], "one lift a scene"),
        (["{folder}/words.safetensors"], "lift"),
        (["{folder}", "--threshold", "soon"], "threshold"),
        (["{folder}", "--negative", "dragon"], "dragon"),
        (["{folder}", "--held-out", "{folder}/none.txt"], "--held-out"),
        (["{folder}", "--table", "{folder}/other.table"], "channels"),
        (["{folder}", "--threshold", "nan"], "threshold"),
        (["{folder}", "--protocol", "P4"], "P4"),
    ],
)
def test_what_cannot_be_judged_exits_2_with_one_line(
    options: list[str], message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [text.format(folder=folder) for text in options]
    status, out, err = run(capsys, "evaluate", "lerf-ovs", *arguments, "--data", folder / "lerf_ovs")
    assert (status, out) == (2, "")
    assert message in err and err.count("\n") == 1


def test_protocol_whose_own_negatives_a_table_lacks_is_left_out_and_said(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vectors, words = load_file(folder / "words.safetensors")["embeddings"], WORDS
    rows = [row for row, word in enumerate(words) if word != "object"]
    small = tmp_path / "small.safetensors"
    save_file({"embeddings": vectors[rows]}, small, metadata={"words": json.dumps([words[row] for row in rows])})
    lift = folder / "kitchen.lift.safetensors"
    arguments = ["lerf-ovs", lift, "--data", folder / "lerf_ovs", "--table", small]
    document = evaluate(capsys, *arguments)
    assert [row["protocol"] for row in document["measured"]] == ["P2", "P3", "own"]
    assert any("P1 is left out" in warning and "without object" in warning for warning in document["warnings"])
    status, _, err = run(capsys, "evaluate", *arguments, "--protocol", "P1")
    assert status == 2 and "--negative" in err
    document = evaluate(capsys, *arguments, "--negative", "book", "--protocol", "P1")
    assert [row["protocol"] for row in document["measured"]] == ["P1"]
