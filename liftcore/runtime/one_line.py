"""Values as Python prints them: in a line."""

from collections.abc import Mapping, Sequence
from typing import Any

MOST = 120  # characters, as wide as terminals and notebooks show without a break
MOST_OF_TEXT = 40  # of a name, a sentence or a list within
MOST_OF_LIST = 3  # items that are shown


def one_line(value: object, *parts: str) -> str:
    """``Name(part, part)`` of the value's class, cut to MOST characters."""
    line = f"{type(value).__name__}({', '.join(parts)})"
    return line if len(line) <= MOST else f"{line[: MOST - 4]}...)"


def point_text(point: Sequence[float]) -> str:
    """Coordinates to three digits."""
    return f"({', '.join(f'{value:.3g}' for value in point)})"


def value_text(value: Any) -> str:
    """A field of a value: a number to three digits, a point, the beginning of a text, a short list, or its length."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, str):
        return repr(value[:MOST_OF_TEXT])
    if isinstance(value, tuple) and 0 < len(value) <= 3 and all(isinstance(one, float) for one in value):
        return point_text(value)
    if isinstance(value, Mapping | list | tuple):
        whole = repr(value) if len(value) <= MOST_OF_LIST else ""
        return whole if 0 < len(whole) <= MOST_OF_TEXT else f"[{len(value)}]"
    return repr(value)[:MOST_OF_TEXT]
