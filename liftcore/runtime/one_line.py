"""One-line representations of values and of lists of names."""

from collections.abc import Sequence, Sized
from typing import Any

MAX_CHARACTERS = 120  # as wide as terminals and notebooks print without a break
MAX_TEXT = 40  # characters of a name, a sentence or a list within


def one_line(value: object, *parts: str) -> str:
    """Return ``Name(part, part)`` of the value's class, cut to MAX_CHARACTERS."""
    line = f"{type(value).__name__}({', '.join(parts)})"
    return line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 4]}...)"


def join_names(names: Sequence[str], limit: int | None) -> str:
    """Join the first ``limit`` names for people; None for all."""
    return ", ".join(names[:limit]) + (", ..." if limit is not None and len(names) > limit else "")


def value_text(value: Any) -> str:
    """Return a field as text: a number to three digits, a short value, or the length of a long list."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, str):  # of an enumeration, its text
        return repr(value[:MAX_TEXT])
    text = repr(value)
    return f"[{len(value)}]" if isinstance(value, Sized) and len(text) > MAX_TEXT else text[:MAX_TEXT]
