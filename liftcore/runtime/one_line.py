"""One-line representations of values and of lists of names."""

from collections.abc import Mapping, Sequence
from typing import Any

MAX_CHARACTERS = 120  # as wide as terminals and notebooks print without a break
MAX_TEXT = 40  # characters of a name, a sentence or a list within
MAX_ITEMS = 3  # of a list that is printed in full


def one_line(value: object, *parts: str) -> str:
    """Return ``Name(part, part)`` of the value's class, cut to MAX_CHARACTERS."""
    line = f"{type(value).__name__}({', '.join(parts)})"
    return line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 4]}...)"


def join_names(names: Sequence[str], limit: int | None) -> str:
    """Join the first ``limit`` names for people; None for all."""
    return ", ".join(names[:limit]) + (", ..." if limit is not None and len(names) > limit else "")


def point_text(point: Sequence[float]) -> str:
    """Return coordinates to three digits."""
    return f"({', '.join(f'{value:.3g}' for value in point)})"


def value_text(value: Any) -> str:
    """Return a field as text: a number to three digits, a point, the start of a text, a short list, or its length."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, str):
        return repr(value[:MAX_TEXT])
    if isinstance(value, tuple) and 0 < len(value) <= 3 and all(isinstance(number, float) for number in value):
        return point_text(value)
    if isinstance(value, Mapping | list | tuple):
        text = repr(value) if len(value) <= MAX_ITEMS else ""
        return text if 0 < len(text) <= MAX_TEXT else f"[{len(value)}]"
    return repr(value)[:MAX_TEXT]
