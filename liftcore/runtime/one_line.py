"""Values as Python prints them: in a line."""

from collections.abc import Mapping, Sequence
from typing import Any

MOST = 120  # characters, as wide as terminals and notebooks show without a break
MOST_OF_TEXT = 40  # of a name or a sentence within


def one_line(value: object, *parts: str) -> str:
    """``Name(part, part)`` of the value's class, cut to MOST characters."""
    line = f"{type(value).__name__}({', '.join(parts)})"
    return line if len(line) <= MOST else f"{line[: MOST - 4]}...)"


def point_text(point: Sequence[float]) -> str:
    """Coordinates to three digits."""
    return f"({', '.join(f'{value:.3g}' for value in point)})"


def value_text(value: Any) -> str:
    """A field of a value: a number to three digits, a point, the beginning of a text, and of a list its length."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, str):
        return repr(value[:MOST_OF_TEXT])
    if isinstance(value, tuple) and 0 < len(value) <= 3 and all(isinstance(one, float) for one in value):
        return point_text(value)
    return f"[{len(value)}]" if isinstance(value, Mapping | list | tuple) else repr(value)[:MOST_OF_TEXT]
