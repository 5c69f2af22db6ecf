"""Checks of arguments of public functions: choices, texts, counts, and single values in place of lists."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput, InvalidSettings, SplatliftError


def one_of(names: Iterable[str]) -> str:
    """Return the text "one of a, b, c", for errors."""
    return f"one of {', '.join(names)}"


def check_choice(
    argument: str, value: object, names: Iterable[str], error: type[SplatliftError] = InvalidInput
) -> None:
    """Refuse a value that is none of these names."""
    names = tuple(names)
    if not isinstance(value, str) or value not in names:
        raise error(argument, expected=one_of(names), got=repr(value)[:80])


def as_path(path: object, argument: str = "path") -> Path:
    """Return an argument as a path."""
    if not isinstance(path, str | PathLike) or not str(path):
        got = f"{type(path).__name__} {path!r}"[:80]
        hint = "give several paths one by one" if isinstance(path, list | tuple) else ""
        raise InvalidInput(argument, expected="the path of a file or folder", got=got, hint=hint)
    return Path(path)


def as_paths(paths: Any, argument: str = "path") -> list[Path]:
    """Return several paths as a list; a single one as a list of one."""
    return [as_path(path, argument) for path in as_list(paths)]


def check_text(argument: str, value: object) -> None:
    """Refuse a value that is no text, or an empty one."""
    if not isinstance(value, str) or not value.strip():
        raise InvalidInput(argument, expected="a non-empty text", got=repr(value)[:80])


def as_list(values: Any) -> list[Any]:
    """Return several values as a list; a single text, path or other value as a list of one."""
    return list(values) if isinstance(values, Iterable) and not isinstance(values, str | PathLike) else [values]


def check_count(argument: str, value: object, none: str = "") -> None:
    """Refuse a count that is no integer of at least one; ``none`` is the meaning of None, empty to refuse it."""
    if none and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        expected = f"a whole number of one or more{none and f', or None for {none}'}"
        raise InvalidSettings(argument, expected=expected, got=repr(value)[:80])
