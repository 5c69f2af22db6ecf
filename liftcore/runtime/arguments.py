"""Arguments of public functions: a choice that is one of its names, and one value where several may be."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from os import PathLike
from typing import Any

from liftcore.errors import InvalidInput, InvalidSettings, SplatliftError


def one_of(names: Iterable[str]) -> str:
    """What is expected where one of these names is."""
    return f"one of {', '.join(names)}"


def check_choice(
    argument: str, value: object, names: Iterable[str], error: type[SplatliftError] = InvalidInput
) -> None:
    """Refuse what is none of these names.

    Raises:
        SplatliftError: of the given type.
    """
    names = tuple(names)
    if not isinstance(value, str) or value not in names:
        raise error(argument, expected=one_of(names), got=repr(value)[:80])


def check_text(argument: str, value: object) -> None:
    """Refuse what is no text, or an empty one.

    Raises:
        InvalidInput: it is one of these.
    """
    if not isinstance(value, str) or not value.strip():
        raise InvalidInput(argument, expected="a text that is not empty", got=repr(value)[:80])


def as_list(values: Any) -> list[Any]:
    """Several values as a list; one text, path or other value alone as a list of it."""
    return list(values) if isinstance(values, Iterable) and not isinstance(values, str | PathLike) else [values]


def check_count(argument: str, value: object, none: str = "") -> None:
    """Refuse a count that is no whole number of one or more; None is one where ``none`` says what it stands for.

    Raises:
        InvalidSettings: it is refused.
    """
    if none and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        expected = f"a whole number of one or more{none and f', or None for {none}'}"
        raise InvalidSettings(argument, expected=expected, got=repr(value)[:80])
