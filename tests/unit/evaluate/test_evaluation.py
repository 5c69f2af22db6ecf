"""``splatlift evaluate`` on masks of phrases: a right lift scores near one, and labelled pixels alone are counted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

import liftcore as lc
from liftcore.evaluate import evaluate_lift
from tests.promises.command_line import run
from tests.promises.tiny_files import write_lift
from tests.tiny_scene import SPLATS_A_CLUSTER, VIEWS, WORDS

LIFT, TABLE = "scene.lift.safetensors", "words.safetensors"


def truth_of(folder: Path) -> dict[str, np.ndarray]:
    """Return where each view shows each word's cluster: [3, H, W] bool."""
    splats, cameras = lc.read_splats(folder / "s.ply"), lc.read_cameras(folder / "c.json")
    owners = torch.eye(3).repeat_interleave(SPLATS_A_CLUSTER, dim=0)
    return {view: (lc.render(splats, cameras[view], owners) > 0.5).permute(2, 0, 1).numpy() for view in VIEWS}


def write_labels(folder: Path, truth: dict[str, np.ndarray], words: tuple[str, ...] = WORDS) -> Path:
    """Write masks PHRASE/VIEW.png at twice the size of the views, as a pack."""
    for number, word in enumerate(words):
        (folder / "masks" / word).mkdir(parents=True)
        for view, masks in truth.items():
            pixels = 255 * masks[number].repeat(2, axis=0).repeat(2, axis=1).astype(np.uint8)
            Image.fromarray(pixels).save(folder / "masks" / word / f"{view}.png")
    lc.pack_folder(folder / "masks", folder / "labels.safetensors", "prompts")
    return folder / "labels.safetensors"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lift of two of three views, and labels of all; tests only read them."""
    path = tmp_path_factory.mktemp("evaluate")
    write_lift(path, view_stride=2)
    write_labels(path, truth_of(path))
    return path


def test_a_right_lift_scores_near_one(folder: Path) -> None:
    words = ["evaluate", folder / LIFT, folder / "labels.safetensors", "--table", folder / TABLE]
    document = run(*words, "--json").document
    means = document["means"]["all labelled"]
    assert (means["frames"], means["objects"], means["localised"]) == (3, 9, 1)
    assert min(means["object_micro"], means["frame_macro"], means["class_pooled"]) > 0.9
    assert document["means"]["held out"]["frames"] == 1
    assert [row["lifted"] for row in document["objects"]] == [row["view"] != "middle" for row in document["objects"]]
    for phrase, pooled in document["classes"].items():
        rows = [row for row in document["objects"] if row["phrase"] == phrase]
        assert pooled == sum(row["intersection"] for row in rows) / sum(row["union"] for row in rows)
    assert run(*words).out.startswith("all labelled: 9 objects in 3 frames, mIoU ")


def test_a_call_evaluates_as_the_command_does(folder: Path) -> None:
    options = ["--threshold", "0.5", "--negative", "lamp", "--table", folder / TABLE]
    document = run("evaluate", folder / LIFT, folder / "labels.safetensors", *options, "--json").document
    labels, table = lc.read_features(folder / "labels.safetensors"), f"table:{folder / TABLE}"
    for lift in (str(folder / LIFT), lc.Scene(folder / LIFT)):
        evaluation = evaluate_lift(lift, labels, encoder=table, threshold=0.5, negatives=["lamp"])
        assert json.loads(json.dumps(evaluation.document())) == document


def test_a_label_is_a_name_whatever_is_in_it(folder: Path, tmp_path: Path) -> None:
    class Reader:
        """An encoder of any text, which takes its last word from the table."""

        name, channels = "any", lc.Scene(folder / LIFT).channels

        def encode(self, texts: Sequence[str]) -> np.ndarray:
            return lc.open_encoder(f"table:{folder / TABLE}").encode([text.split()[-1] for text in texts])

    labels = write_labels(tmp_path, truth_of(folder), ("other apple", "salt and book", "no left base of the lamp"))
    evaluation = evaluate_lift(folder / LIFT, labels, encoder=Reader())
    assert min(row.iou or 0 for row in evaluation.objects) > 0.9


def test_unlabelled_pixels_count_nowhere(folder: Path, tmp_path: Path) -> None:
    """The book's right half is unlabelled, and the apple is called a book: only labelled pixels are counted."""
    apple, book, _ = truth_of(folder)["middle"]
    left_half = book & (np.arange(book.shape[1]) < book.shape[1] / 2)
    vector = torch.eye(2)[:1]
    labels = torch.from_numpy(np.where(left_half | apple, 0, -1).astype(np.int32))
    tensors = {"embeddings": vector, "middle/labels": labels[None], "middle/codebook": vector.clone()}
    save_file(tensors, tmp_path / "half", metadata={"words": '["book"]', "encoder": "phrases"})
    (row,) = evaluate_lift(folder / LIFT, tmp_path / "half", encoder=f"table:{folder / TABLE}", threshold=0.5).objects
    assert row.truth == row.union == (left_half | apple).sum()
    assert row.intersection == pytest.approx(left_half.sum(), rel=0.05)


def test_words_and_views_that_cannot_be_evaluated_are_named(folder: Path, tmp_path: Path) -> None:
    truth = truth_of(folder)
    labels = write_labels(tmp_path, truth | {"new": truth["left"]}, ("apple", "griffin"))
    document = run("evaluate", folder / LIFT, labels, "--table", folder / TABLE, "--json").document
    assert document["classes"].keys() == {"apple"}
    assert any("lacks 'griffin': left out" in warning for warning in document["warnings"])
    assert any("'new' have labels but no camera" in warning for warning in document["warnings"])
    tensors = load_file(labels)
    del tensors["embeddings"]
    save_file(tensors, tmp_path / "plain.safetensors", metadata={"encoder": "phrases"})
    with pytest.raises(lc.InvalidInput, match="a pack of masks of phrases"):
        evaluate_lift(folder / LIFT, tmp_path / "plain.safetensors")
