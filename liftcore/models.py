"""Public: what questions and bodies of requests are made of, for programs that serve them. Loads no torch."""

from liftcore.query.question import (
    METHODS,
    AskableWords,
    BestWords,
    Found,
    FoundWords,
    ListedObjects,
    Notation,
    OwnCamera,
    Seen,
)
from liftcore.query.terms import NOTATIONS
from liftcore.runtime.fields import Body, NoBoolean, takes

__all__ = [
    "METHODS", "NOTATIONS", "AskableWords", "BestWords", "Body", "Found", "FoundWords", "ListedObjects", "NoBoolean",
    "Notation", "OwnCamera", "Seen", "takes",
]  # fmt: skip
