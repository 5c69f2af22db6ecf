"""How the words of a table are told from one another, and which are near to one that it lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.nearest import nearest as nearest_names

if TYPE_CHECKING:
    from collections.abc import Iterable

_ARTICLES = frozenset({"a", "an", "the"})
_NEAREST = 5  # words named when one is unknown


def plain(text: str) -> str:
    """The text as tables compare it: cases, ``_`` for a space and a leading article make no difference."""
    parts = text.casefold().replace("_", " ").split()
    if len(parts) > 1 and parts[0] in _ARTICLES:
        parts = parts[1:]
    return " ".join(parts)


def nearest(text: str, words: Iterable[str]) -> str:
    """A hint that names the words most like the text, of the first thousands; the words are `plain`."""
    return nearest_names(plain(text), words, _NEAREST)
