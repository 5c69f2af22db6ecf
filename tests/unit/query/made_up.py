"""Answers with a selection that a test chooses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from liftcore.query.question import Answer, Presence

if TYPE_CHECKING:
    import numpy as np


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
