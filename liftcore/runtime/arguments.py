"""Checks of arguments of public functions: choices, texts, counts, and single values in place of lists."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from os import PathLike
from typing import Any

from liftcore.errors import InvalidInput, InvalidSettings, SplatliftError


def one_of(names: Iterable[str]) -> str:
    """Return the text "one of a, b, c", for errors."""
    return f"one of {', '.join(names)}"


def check_choice(
    argument: str, value: object, names: Iterable[str], error: type[SplatliftError] = InvalidInput
) -> None:
    """Refuse a value that is none of these names.

    Raises:
        SplatliftError: of the type ``error``.
    """
    names = tuple(names)
    if not isinstance(value, str) or value not in names:
        raise error(argument, expected=one_of(names), got=repr(value)[:80])


def check_text(argument: str, value: object) -> None:
    """Refuse a value that is no text, or an empty one.

    Raises:
        InvalidInput: the value is refused.
    """
    if not isinstance(value, str) or not value.strip():
        raise InvalidInput(argument, expected="a non-empty text", got=repr(value)[:80])


def as_list(values: Any) -> list[Any]:
    """Return several values as a list; a single text, path or other value as a list of one."""
    return list(values) if isinstance(values, Iterable) and not isinstance(values, str | PathLike) else [values]


def check_count(argument: str, value: object, none: str = "") -> None:
    """Refuse a count that is no integer of at least one; ``none`` is the meaning of None, empty if None is refused.

    Raises:
        InvalidSettings: the count is refused.
    """
    if none and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        expected = f"a whole number of one or more{none and f', or None for {none}'}"
        raise InvalidSettings(argument, expected=expected, got=repr(value)[:80])
