"""Candidates of a click: the nested objects and parts at that place, the smallest first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.text.table import TableEncoder

from .made_up import with_parts


def candidates_of(scene: Scene, like: str) -> list[tuple[int, str]]:
    """Return the id and kind of each candidate."""
    return [(candidate.id, candidate.kind) for candidate in scene.ask(Query(like=[like])).candidates]


def test_a_part_that_is_nearly_all_of_its_whole_is_not_offered_beside_it(scene: Scene, tmp_path: Path) -> None:
    lift = with_parts(scene)
    assert lift.node is not None and lift.object is not None
    node, rows = lift.node.clone(), torch.nonzero(lift.object == 0)[:, 0]
    node[rows], node[rows[: len(rows) // 10]] = 3, 4
    replace(lift, node=node).save(tmp_path / "parts.lift.safetensors")
    subject = Scene(tmp_path / "parts.lift.safetensors", scene.splats, scene.cameras)
    assert candidates_of(subject, f"splat:{int(rows[-1])}") == [(0, "object")]
    assert candidates_of(subject, f"splat:{int(rows[0])}") == [(4, "part"), (0, "object")]


def test_a_part_that_no_word_stands_for_may_be_any_part_of_its_thing(nested: Scene) -> None:
    row = np.flatnonzero(nested.members(3))[0]
    words = np.stack([nested.features[row], -nested.features[row]]).astype(np.float32)
    table = TableEncoder("words", ["apple", "lamp"], words)
    answer = nested.ask("the apple's stalk", encoder=table)
    assert answer.count and [word.match for word in answer.wording] == ["head"]
    assert sorted((candidate.id, candidate.kind) for candidate in answer.candidates) == [(3, "part"), (4, "part")]
    assert "'stalk'" in answer.reason and "all of 'apple'" in answer.reason
    assert sum(candidate.share for candidate in answer.candidates) <= 1 + 1e-6
    assert nested.ask("the apple", encoder=table).candidates == ()
