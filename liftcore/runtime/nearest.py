"""Hints with the names that are most similar to a text, at a bounded cost."""

from __future__ import annotations

from difflib import SequenceMatcher
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_CHARACTERS = 80  # of each name, and of the text, that are compared and printed
_MAX_NAMES = 2000  # names that are compared; longer lists would delay other requests
_MAX_CHARACTERS = 40_000  # of the compared names, each counted as long as the longest: a fifth of a second


def nearest(text: str, names: Iterable[str], count: int) -> str:
    """Return a hint with the ``count`` names most similar to the text, of the first thousands, by their first
    letters.

    Names that begin with the text as a word come first: "car (automobile)" for "car", before "scarf".
    """
    text, cut = text[:_CHARACTERS], [name[:_CHARACTERS] for name in islice(names, _MAX_NAMES)]
    begin = [name for name in cut if text and name.startswith(f"{text} ")]
    limit = _MAX_CHARACTERS // max(1, *map(len, cut), 1)
    matcher = SequenceMatcher(b=text)

    def likeness(name: str) -> float:
        matcher.set_seq1(name)
        return matcher.ratio()

    ranked = sorted(cut[:limit], key=likeness, reverse=True)  # stable: equally near names keep their order
    return f"nearest: {', '.join(list(dict.fromkeys([*begin, *ranked]))[:count])}"
