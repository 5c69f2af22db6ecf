"""Public: models of queries and of bodies of requests, for programs that serve them. Loads no torch."""

from liftcore.query.edits import Edit
from liftcore.query.question import (
    METHODS,
    AskableWords,
    BestWords,
    Box,
    Found,
    FoundWords,
    ListedObjects,
    Notation,
    OwnCamera,
    SceneTree,
    Seen,
)
from liftcore.query.terms import NOTATIONS
from liftcore.runtime.fields import Body, NoBoolean, takes

__all__ = [
    "METHODS", "NOTATIONS", "AskableWords", "BestWords", "Body", "Box", "Edit", "Found", "FoundWords",
    "ListedObjects", "NoBoolean", "Notation", "OwnCamera", "SceneTree", "Seen", "takes",
]  # fmt: skip
