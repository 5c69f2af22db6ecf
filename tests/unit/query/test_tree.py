"""The list of a lift's objects and parts, with their positions, views and nearest words of a vocabulary."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidLift, NotFound
from liftcore.query.result import LiftResult, load_lift
from liftcore.query.scene import Scene
from liftcore.values.lift_file import NODE_TENSORS, save_lift
from liftcore.values.settings import LiftSettings
from tests.tiny_scene import CHANNELS, WORDS

from .made_up import EYE, with_parts


def test_a_draft_says_that_it_looked_for_no_objects_and_what_finds_them(scene: Scene, tmp_path: Path) -> None:
    metadata = scene.lift.metadata.model_copy(update={"settings": LiftSettings.of(quality="draft")})
    bare = {field: None for field in vars(LiftResult.of(scene.lift)) if field.startswith(("object", "node"))}
    save_lift(replace(scene.lift, metadata=metadata, **bare), tmp_path / "draft.lift")
    draft = Scene(tmp_path / "draft.lift")
    explanation = draft.tree().explanation
    assert "quality=draft" in explanation and "objects=auto" in explanation
    with pytest.raises(NotFound, match="objects=auto"):
        draft.export(tmp_path / "object.ply", source=0)


def test_parts_have_paths_places_and_names_of_what_their_own_masks_say(nested: Scene) -> None:
    tree = nested.tree(WORDS, EYE)
    assert [(node.id, node.kind, node.parent) for node in tree.nodes[:3]] == [(n, "object", None) for n in range(3)]
    assert tree.objects == tree.nodes[:3] and {node.name for node in tree.objects} == set(WORDS)
    assert [(node.kind, node.path, node.name) for node in tree.nodes[3:]] == [
        ("part", (0, 3), WORDS[1]), ("part", (0, 4), WORDS[2])
    ]  # fmt: skip
    assert tree.nodes[0].parts == (3, 4) and tree.nodes[0].splats == sum(node.splats for node in tree.nodes[3:])
    for node in tree.nodes:
        inside = nested.members(node.id)
        assert inside.sum() == node.splats and set(np.flatnonzero(inside)) <= set(
            np.flatnonzero(nested.members(node.path[0]))
        )
    with pytest.raises(NotFound, match="from 0 to 4"):
        nested.members(5)


def test_rows_of_a_lift_keep_their_part_of_the_tree(scene: Scene) -> None:
    lift = with_parts(scene)
    assert lift.node is not None
    cropped = lift[(lift.node != 1) & (lift.node != 3)]
    assert cropped.node is not None and cropped.node_parents is not None and cropped.object_views is not None
    assert cropped.node_parents.tolist() == [-1, -1, 0] and len(cropped.object_views) == 2
    assert torch.equal((cropped.node == 2), lift.node[(lift.node != 1) & (lift.node != 3)] == 4)


@pytest.mark.parametrize(
    "change",
    [
        {"node_parents": torch.tensor([-1, -1, -1, 4, 3]).int()},
        {"node_parents": torch.tensor([-1, -1, -1, 0, 9]).int()},
        {"node_confidence": torch.ones(4)},
        {"node_views": None},
        {"cluster": torch.full((60,), 3).int(), "cluster_features": torch.zeros(3, CHANNELS).half()},
        {"cluster": torch.zeros(59).int(), "cluster_features": torch.zeros(3, CHANNELS).half()},
    ],
    ids=["a circle", "no such node", "too few", "one of them", "no such cluster", "too few rows"],
)
def test_a_tree_or_clusters_that_are_none_are_refused(
    scene: Scene, tmp_path: Path, change: dict[str, torch.Tensor]
) -> None:
    save_lift(replace(with_parts(scene), **change), tmp_path / "wrong.lift")
    with pytest.raises(InvalidLift, match=r"tree|cluster"):
        load_lift(tmp_path / "wrong.lift")


def test_objects_without_a_tree_are_listed_as_objects_without_parts(scene: Scene) -> None:
    bare = replace(scene.lift, **dict.fromkeys(NODE_TENSORS))
    tree = Scene(bare, scene.splats, scene.cameras).tree(WORDS, EYE)
    assert [(obj.id, obj.kind, obj.parts, obj.confidence) for obj in tree.nodes] == [
        (number, "object", (), None) for number in range(3)
    ]
    assert {obj.name for obj in tree.objects} == set(WORDS)


def test_objects_without_splats_are_left_out(scene: Scene, tmp_path: Path) -> None:
    lift = scene.lift
    assert lift.object_views is not None
    tree = {
        "node": lift.object, "node_parents": torch.tensor([-1, -1, -1, -1, 0], dtype=torch.int32),
        "node_views": lift.object_views[[0, 1, 2, 0, 0]], "node_confidence": torch.ones(5),
        "node_features": torch.zeros(5, lift.features.shape[1], dtype=torch.float16),
    }  # fmt: skip
    save_lift(replace(lift, object_views=lift.object_views[[0, 1, 2, 0]], **tree), tmp_path / "l.safetensors")
    other = Scene(tmp_path / "l.safetensors")
    assert [(obj.id, obj.parts) for obj in other.tree().nodes] == [(0, ()), (1, ()), (2, ())]
    assert len(other.labels(other.tree()).document["instances"]) == 3
