"""Answers with a selection, and lifts with parts, that a test chooses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from liftcore.query.question import Answer, Presence
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.values.lift_file import NODE_TENSORS
from tests.tiny_scene import CHANNELS

EYE = np.eye(3, CHANNELS, dtype=np.float32)


def answer_with(
    answer: Answer, *, selected: np.ndarray | None = None, scores: np.ndarray | None = None, **query: Any
) -> Answer:
    """Return the answer with other splats [P] bool, other scores [P], or other fields of its query."""
    fields = {name: getattr(answer, name) for name in (*Presence.model_fields, "threshold", "clear", "statistics")}
    return Answer.of(
        answer.query.model_copy(update=query),
        answer.scores if scores is None else scores,
        answer.has_feature,
        answer.selected if selected is None else selected,
        **fields,
    )


def with_parts(scene: Scene) -> LiftResult:
    """Return the lift with its first object in two halves, whose features differ from the object's."""
    lift = LiftResult.of(scene.lift.cpu())
    assert lift.object is not None and lift.object_views is not None and lift.node_features is not None
    node, first = lift.object.clone(), torch.nonzero(lift.object == 0)[:, 0]
    node[first[::2]], node[first[1::2]] = 3, 4
    vectors = torch.from_numpy(np.concatenate([EYE, 3 * EYE[[1, 2]]])).half()
    return replace(
        lift, node=node, node_parents=torch.tensor([-1, -1, -1, 0, 0]).int(), node_features=vectors,
        node_views=torch.cat([lift.object_views, lift.object_views[[0, 0]]]), node_confidence=torch.ones(5) / 2,
    )  # fmt: skip


def lifted(scene: Scene, features: np.ndarray, **fields: Any) -> Scene:
    """Return the scene with these features [P, F], of total weight one."""
    ones = torch.ones(len(features))
    defaults = {
        "total_weight": ones,
        "has_feature": ones > 0,
        **dict.fromkeys(("object", "object_views", *NODE_TENSORS)),
    }
    return Scene(replace(scene.lift, rows=torch.from_numpy(features.astype(np.float32)), **defaults | fields))
