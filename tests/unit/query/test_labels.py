"""Label files of all splats, in one format for words, an answer and the objects of a lift."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from liftcore.errors import InvalidQuery, InvalidSplats
from liftcore.io.labels import Labels
from liftcore.io.splats import read_splats
from liftcore.query.coco import run_lengths
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.query.terms import Vector
from tests.promises.command_line import run
from tests.tiny_scene import AXES, CHANNELS, WORDS, text_table
from tests.unit.scene.test_gltf import document_of

from .made_up import EYE


def read_labels(path: Path) -> Labels:
    """Read the columns and the document of a ``.ply`` or a ``.glb``."""
    columns = {name: column.numpy() for name, column in read_splats(path).extras.items()}
    if path.suffix == ".glb":
        return Labels(columns, document_of(path))
    return Labels(columns, json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8")))


def test_every_source_gives_instances_that_lie_in_their_boxes(scene: Scene) -> None:
    answer = scene.ask(Query.of((Vector(tuple(AXES[2])),), threshold=0.5))
    sources = scene.segment(WORDS, EYE), answer, scene.tree(WORDS, EYE), scene.tree()
    for source, classes, instances in zip(sources, (3, 1, 3, 0), (3, 1, 3, 3), strict=True):
        labels = scene.labels(source)
        assert [len(labels.document[kind]) for kind in ("classes", "instances")] == [classes, instances]
        for instance in labels.document["instances"]:
            inside = labels.columns["instance_id"] == instance["instance_id"]
            assert inside.sum() == instance["splats"]
            if classes:
                assert set(labels.columns["class_id"][inside]) == {instance["class_id"]}
                assert instance["name"] == labels.document["classes"][instance["class_id"] - 1]["name"]
            places = scene.splats.positions()[inside]
            low, high = instance["box"]["low"], instance["box"]["high"]
            assert (places >= np.array(low) - 1e-6).all() and (places <= np.array(high) + 1e-6).all()
            box = instance["oriented_box"]
            sides = (places - box["centre"]) @ np.array(box["axes"]).T
            assert (np.abs(sides) <= np.array(box["half_sizes"]) + 1e-5).all()
            assert np.linalg.det(box["axes"]) == pytest.approx(1)  # right-handed, each of length one
    with pytest.raises(InvalidQuery, match="an answer with selected splats"):
        scene.labels(scene.ask(Query.of((Vector((1.0,) * CHANNELS),), threshold=1.0)))


def test_a_splat_of_two_answers_is_of_that_whose_threshold_it_exceeds_more(scene: Scene) -> None:
    vector = Vector(tuple(AXES[0]))
    narrow, wide = (scene.ask(Query.of((vector,), threshold=cut), places=False) for cut in (0.9, 0.1))
    rows = np.flatnonzero(narrow.selected)
    for answer, score in ((narrow, 0.95), (wide, 0.6)):  # a half and 5/9 of the way up from the threshold
        answer.scores[rows[1:]] = score
    labels = scene.labels({"narrow": narrow, "wide": wide})
    assert labels.columns["class_id"][rows].tolist() == [1, *[2] * (len(rows) - 1)]


def test_masks_in_views_are_those_of_the_instances(scene: Scene, tmp_path: Path) -> None:
    segmentation = scene.segment(WORDS, EYE)
    scene.export(tmp_path / "m.json", segmentation)
    document = json.loads((tmp_path / "m.json").read_text(encoding="utf-8"))
    assert [entry["file_name"] for entry in document["images"]] == list(scene.metadata.views)
    names = {entry["id"]: entry["name"] for entry in document["categories"]}
    assert sorted(names.values()) == sorted(WORDS)
    view = next(entry for entry in document["images"] if entry["file_name"] == "middle")
    annotations = [entry for entry in document["annotations"] if entry["image_id"] == view["id"]]
    assert len(annotations) == 3
    for entry in annotations:
        assert sum(entry["segmentation"]["counts"]) == view["width"] * view["height"]
        assert sum(entry["segmentation"]["counts"][1::2]) == entry["area"] > 0
        centre = entry["bbox"][0] + entry["bbox"][2] / 2
        assert WORDS.index(names[entry["category_id"]]) == int(3 * centre / view["width"])


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_files_of_a_tree_come_back_with_paths_and_the_smallest_nodes(
    nested: Scene, tmp_path: Path, suffix: str
) -> None:
    (tmp_path / "words.safetensors").write_bytes(text_table())
    words = ["-o", tmp_path / f"x{suffix}", "--table", tmp_path / "words.safetensors"]
    assert run("export", nested.path, *words, "--json").document["nodes"] == 5
    labels = read_labels(tmp_path / f"x{suffix}")
    assert nested.node is not None and nested.object is not None
    np.testing.assert_array_equal(labels.columns["node_id"], nested.node + 1)
    np.testing.assert_array_equal(labels.columns["instance_id"], nested.object + 1)
    nodes = {tree_node["node_id"]: tree_node for tree_node in labels.document["nodes"]}
    tree = nested.tree(WORDS, EYE).nodes
    assert set(nodes) == {tree_node.id + 1 for tree_node in tree}
    for tree_node in tree:
        entry = nodes[tree_node.id + 1]
        assert (entry["kind"], entry["name"], entry["splats"]) == (tree_node.kind, tree_node.name, tree_node.splats)
        assert (
            list(entry["path"]) == [node + 1 for node in tree_node.path] and entry["depth"] == len(tree_node.path) - 1
        )
        assert list(entry["parts"]) == [node + 1 for node in tree_node.parts]
        assert entry["parent"] == (0 if tree_node.parent is None else tree_node.parent + 1)
    for tree_node in labels.document["instances"]:
        assert list(tree_node["path"]) == [tree_node["instance_id"]]


def test_rows_of_labels_keep_the_nodes_that_hold_theirs(nested: Scene) -> None:
    labels = nested.labels(nested.tree())
    subset = labels.subset(labels.columns["node_id"] == 4)
    assert [node["node_id"] for node in subset.document["nodes"]] == [1, 4]


def test_run_lengths_are_columns_and_begin_with_zeros() -> None:
    mask = np.array([[1, 0], [1, 0], [0, 1]], np.bool_)
    assert run_lengths(mask) == [0, 2, 3, 1] and run_lengths(~mask) == [2, 3, 1]
    assert run_lengths(np.zeros((2, 2), np.bool_)) == [4]


@pytest.mark.parametrize("suffix", [".splat", ".spz"])
def test_a_format_without_labels_is_refused_for_a_tree(nested: Scene, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"tree{suffix}"
    with pytest.raises(InvalidSplats, match="which hold labels"):
        nested.export(path, nested.tree())
    assert not path.exists()
