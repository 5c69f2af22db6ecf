"""How the words of a table are told from one another, and which are near to one that it lacks."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_ARTICLES = frozenset({"a", "an", "the"})
_NEAREST = 5  # words named when one is unknown
_SHOWN = 80  # characters of each, and of the text that is compared
_COMPARED = 2000  # words that a hint looks at: all of a long table would hold up other requests for seconds


def plain(text: str) -> str:
    """The text as tables compare it: cases, ``_`` for a space and a leading article make no difference."""
    parts = text.casefold().replace("_", " ").split()
    if len(parts) > 1 and parts[0] in _ARTICLES:
        parts = parts[1:]
    return " ".join(parts)


def nearest(text: str, words: Iterable[str]) -> str:
    """A hint that names the words most like the text, of the first thousands; the words are `plain`."""
    from rapidfuzz import process

    found = process.extract(plain(text)[:_SHOWN], list(islice(words, _COMPARED)), limit=_NEAREST)
    return f"nearest: {', '.join(word[:_SHOWN] for word, _, _ in found)}"
