"""Public: models of queries and of bodies of requests, for programs that serve them. Loads no torch."""

from liftcore.query.edits import Edit
from liftcore.query.question import (
    VIEW_CHARACTERS,
    BestWords,
    Box,
    LabelSummary,
    Notation,
    OwnCamera,
    SceneTree,
    SelectionSummary,
    SuggestedWords,
    Viewpoint,
    WithUnits,
    page_fields,
)
from liftcore.query.terms import NOTATIONS
from liftcore.runtime.fields import Body, NoBoolean, takes

__all__ = [
    "NOTATIONS", "VIEW_CHARACTERS", "BestWords", "Body", "Box", "Edit", "LabelSummary", "NoBoolean", "Notation",
    "OwnCamera", "SceneTree", "SelectionSummary", "SuggestedWords", "Viewpoint", "WithUnits", "page_fields", "takes",
]  # fmt: skip
