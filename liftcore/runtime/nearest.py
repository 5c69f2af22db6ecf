"""Hints that name what is most like a text, at a cost that neither its length nor that of a list runs up."""

from __future__ import annotations

from difflib import SequenceMatcher
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_SHOWN = 80  # characters of each name, and of the text, that are compared and shown
_COMPARED = 2000  # names that a hint looks at, fewer of long ones: all of a long list would hold up other requests
_COMPARED_CHARACTERS = 40_000  # of these names, were all as long as the longest: a fifth of a second


def nearest(text: str, names: Iterable[str], count: int) -> str:
    """A hint that names the ``count`` names most like the text, of the first thousands and by their first letters.

    Names that begin with the whole text come first: "car (automobile)" for "car", before "scarf".
    """
    text, cut = text[:_SHOWN], [name[:_SHOWN] for name in islice(names, _COMPARED)]
    begin = [name for name in cut if text and name.startswith(f"{text} ")]
    most = _COMPARED_CHARACTERS // max(1, *map(len, cut), 1)
    matcher = SequenceMatcher(b=text)

    def likeness(name: str) -> float:
        matcher.set_seq1(name)
        return matcher.ratio()

    alike = sorted(cut[:most], key=likeness, reverse=True)  # of names as near the first, as they were listed
    return f"nearest: {', '.join(list(dict.fromkeys([*begin, *alike]))[:count])}"
