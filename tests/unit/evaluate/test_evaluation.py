"""``splatlift evaluate`` on masks of phrases: a right lift scores near one, and pixels are counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

import liftcore as lc
from liftcore.evaluate import evaluate_lift
from tests.labelled_scene import FRAMES, LIFTED, OBJECTS, truth, write_lift
from tests.promises.command_line import run

LIFT = "kitchen.lift.safetensors"


def write_labels(folder: Path, frames: dict[str, int], words: tuple[str, ...] = tuple(OBJECTS)) -> Path:
    """Masks PHRASE/VIEW.png at twice the size of the views, as a pack."""
    for name, source in zip(words, OBJECTS, strict=False):
        (folder / "masks" / name).mkdir(parents=True)
        for frame, disparity in frames.items():
            mask = Image.fromarray(truth(source, disparity).astype(np.uint8) * 255)
            mask.resize((2 * mask.width, 2 * mask.height), Image.Resampling.NEAREST).save(
                folder / "masks" / name / f"{frame}.png"
            )
    lc.pack_folder(folder / "masks", folder / "labels.safetensors", "prompts")
    return folder / "labels.safetensors"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lift and labels of it; tests only read them."""
    path = tmp_path_factory.mktemp("evaluate")
    write_lift(path)
    write_labels(path, FRAMES)
    save_file({"embeddings": torch.eye(4)}, path / "other.table", metadata={"words": '["a", "b", "c", "d"]'})
    return path


def test_a_right_lift_scores_near_one(folder: Path) -> None:
    document = run("evaluate", folder / LIFT, folder / "labels.safetensors", "--json").document
    means = document["means"]["all labelled"]
    assert (means["frames"], means["objects"], means["localised"]) == (2, 4, 1)
    assert min(means["object_micro"], means["frame_macro"], means["class_pooled"]) > 0.9
    assert document["means"]["held out"]["frames"] == 1
    assert [row["lifted"] for row in document["objects"]] == [row["view"] == LIFTED for row in document["objects"]]
    assert document["warnings"] == [f"1 of 2 labelled views were lifted: '{LIFTED}'"]
    for phrase, pooled in document["classes"].items():
        rows = [row for row in document["objects"] if row["phrase"] == phrase]
        assert pooled == sum(row["intersection"] for row in rows) / sum(row["union"] for row in rows)
    out = run("evaluate", folder / LIFT, folder / "labels.safetensors").out
    assert out.startswith("all labelled: 4 objects in 2 frames, mIoU 9") and "red apple: IoU 9" in out


def test_a_call_evaluates_as_the_command_does(folder: Path) -> None:
    options = ["--threshold", "0.5", "--negative", "wall", "stuff"]
    document = run("evaluate", folder / LIFT, folder / "labels.safetensors", *options, "--json").document
    labels = lc.read_features(folder / "labels.safetensors")
    for lift in (str(folder / LIFT), lc.Scene(folder / LIFT)):
        evaluation = evaluate_lift(lift, labels, threshold=0.5, negatives=["wall", "stuff"])
        assert json.loads(json.dumps(evaluation.document())) == document


def test_unlabelled_pixels_count_nowhere(folder: Path, tmp_path: Path) -> None:
    """Half of the book is unlabelled, and the wall beside it is called a book: only labelled pixels are counted."""
    labels = torch.full((1, 120, 160), -1, dtype=torch.int32)
    labels[0, 20:100, 70:115] = 0  # wall, then the left half of the book
    vector = torch.eye(2)[:1]
    tensors = {"embeddings": vector, f"{LIFTED}/labels": labels, f"{LIFTED}/codebook": vector.clone()}
    save_file(tensors, tmp_path / "half", metadata={"words": '["book"]', "encoder": "phrases"})
    (row,) = evaluate_lift(folder / LIFT, tmp_path / "half", threshold=0.5).objects
    assert (row.truth, row.union) == (80 * 45, 80 * 45)
    assert row.intersection == pytest.approx(80 * 25, rel=0.05)


def test_words_that_the_encoder_lacks_and_views_without_cameras_are_named(folder: Path, tmp_path: Path) -> None:
    labels = write_labels(tmp_path, {**FRAMES, "frame_00009": 0}, ("red apple", "griffin"))
    document = run("evaluate", folder / LIFT, labels, "--json").document
    assert document["classes"].keys() == {"red apple"}
    assert any("lacks 'griffin': left out" in warning for warning in document["warnings"])
    assert any("'frame_00009' have labels but no camera" in warning for warning in document["warnings"])


def test_labels_without_phrases_or_of_other_views_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(lc.InvalidInput, match="views named like"):
        evaluate_lift(folder / LIFT, write_labels(tmp_path, {"other": 0}))
    tensors = load_file(tmp_path / "labels.safetensors")
    del tensors["embeddings"]
    save_file(tensors, tmp_path / "plain.safetensors", metadata={"encoder": "phrases"})
    with pytest.raises(lc.InvalidInput, match="a pack of masks of phrases"):
        evaluate_lift(folder / LIFT, tmp_path / "plain.safetensors")
