"""Checks of arguments of public functions: choices, texts, counts, devices, and single values in place of lists."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput, InvalidSettings, SplatliftError

_CHARACTERS = 80  # of each name, and of the text, that are compared and printed
_MAX_NAMES = 2000  # names that are compared; longer lists would delay other requests
_DEVICE_NUMBER = re.compile(r"cuda:([0-9]{1,4})")


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


def as_paths(paths: Any, argument: str) -> list[Path]:
    """Return several paths as a list; a single one as a list of one."""
    return [as_path(path, argument) for path in as_list(paths)]


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


def device_name(device: object) -> object:
    """Return ``cuda`` for the current GPU, given as ``cuda:0`` or a ``torch.device``; other values unchanged."""
    name = str(device) if type(device).__module__ == "torch" else device
    match = _DEVICE_NUMBER.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        return name
    torch, number = sys.modules.get("torch"), int(match[1])
    current = torch.cuda.current_device() if torch is not None and torch.cuda.is_available() else 0
    if number != current:
        hint = f"set CUDA_VISIBLE_DEVICES={number}, or call torch.cuda.set_device({number}), and use device=cuda"
        raise InvalidSettings("device", expected=f"cuda:{current}, the current GPU", got=repr(str(name)), hint=hint)
    return "cuda"


def nearest(text: str, names: Iterable[str], count: int) -> str:
    """Return a hint with the ``count`` most similar names, of the first thousands, by their first letters."""
    short_names = dict.fromkeys(name[:_CHARACTERS] for name in islice(names, _MAX_NAMES))
    return f"nearest: {', '.join(get_close_matches(text[:_CHARACTERS], short_names, count, cutoff=0.0))}"
