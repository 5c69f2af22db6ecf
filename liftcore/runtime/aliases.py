"""Old public names: read as the new ones, in Python with a `DeprecationWarning`, and never written to a file.

One entry ``old: new`` of a mapping here is called an alias. An
old and a new name with different values are an error, as either could be the one that was meant.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import getattr_static
from typing import Any, ClassVar, Self, TypeVar, cast

from liftcore.errors import InvalidInput, SplatliftError

T = TypeVar("T")
C = TypeVar("C", bound=type)
F = TypeVar("F", bound=Callable[..., Any])
VALUE_CHARACTERS = 60  # characters of a value in an error


def current_names(
    values: Mapping[str, T], aliases: Mapping[str, str], error_type: type[SplatliftError] = InvalidInput
) -> dict[str, T]:
    """Return values under their new names, each in its place.

    Args:
        values: by old and new names. aliases: new names by old ones.

    Raises:
        SplatliftError: of ``error_type``; an old and a new name have different values.
    """
    values = dict(values)  # an `AliasedDict` has the values of new names by old ones
    for old, new in aliases.items():
        if old in values and new in values and not _equal(values[old], values[new]):
            got = " and ".join(f"{name}={values[name]!r}"[:VALUE_CHARACTERS] for name in (new, old))
            expected = f"one value: {old} is the old name of {new}"
            raise error_type(new, expected=expected, got=got, hint=f"leave {old} out")
    return {aliases.get(name, name): value for name, value in values.items()}


def with_old_names(values: Mapping[str, Any], aliases: Mapping[str, str]) -> dict[str, Any]:
    """Return values with each old name behind its new one, as replies have both."""
    olds: dict[str, list[str]] = {}
    for old, new in aliases.items():
        olds.setdefault(new, []).append(old)
    return {key: value for name, value in values.items() for key in (name, *olds.get(name, ()))}


def deprecated_names(**aliases: str) -> Callable[[C], C]:
    """Let a class have attributes and keyword arguments by their old names, each with a `DeprecationWarning`.

    Args:
        aliases: new names by old ones.
    """

    def decorate(cls: C) -> C:
        add_deprecated_properties(cls, aliases)
        initialise = cls.__init__

        @wraps(initialise)
        def initialise_by_names(self: Any, *args: Any, **keywords: Any) -> None:
            for old in aliases.keys() & keywords.keys():
                _warn(cls.__name__, old, aliases[old])
            initialise(self, *args, **current_names(keywords, aliases))

        cls.__init__ = initialise_by_names
        return cls

    return decorate


def add_deprecated_properties(cls: type, aliases: Mapping[str, str]) -> None:
    """Let attributes and methods of a class be read by old names, each with a `DeprecationWarning`."""
    for old, new in aliases.items():
        if isinstance(getattr_static(cls, new, None), classmethod):
            setattr(cls, old, _deprecated_classmethod(new, old))
        else:
            setattr(cls, old, property(deprecated_getter(new, old), doc=f"Deprecated: `{new}`."))


def _deprecated_classmethod(new: str, old: str) -> classmethod[Any, ..., Any]:
    def call_new(cls: type, *args: Any, **keywords: Any) -> Any:
        _warn(cls.__name__, old, new)
        return getattr(cls, new)(*args, **keywords)

    return classmethod(call_new)


def deprecated_getter(new: str, old: str = "", readers: tuple[str, ...] = ()) -> Callable[[Any], Any]:
    """Return a getter of an attribute by its old name, which warns.

    Args:
        new: the attribute. old: its old name, for the warning. readers: packages that read it without a warning.
    """

    def read_new(self: Any) -> Any:
        caller = sys._getframe(1).f_globals.get("__name__", "")
        if caller.partition(".")[0] not in readers:
            _warn(type(self).__name__, old, new)
        return getattr(self, new)

    return read_new


def deprecated_keywords(**aliases: str) -> Callable[[F], F]:
    """Let a function take keyword arguments by their old names, each with a `DeprecationWarning`.

    Args:
        aliases: new names by old ones.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def call_by_names(*args: Any, **keywords: Any) -> Any:
            for old in aliases.keys() & keywords.keys():
                _warn(function.__qualname__, old, aliases[old])
            return function(*args, **current_names(keywords, aliases))

        return cast("F", call_by_names)

    return decorate


class AliasedDict(dict[str, Any]):
    """A dictionary whose values are read by old keys too, each with a `DeprecationWarning`; it lists the new ones."""

    aliases: ClassVar[Mapping[str, str]] = {}  # new keys by old ones

    def __missing__(self, key: str) -> Any:
        """Return the value of the new key of an old one."""
        new = self.aliases.get(key)
        if new is None:
            raise KeyError(key)
        _warn(type(self).__name__, key, new)
        return self[new]

    def __contains__(self, key: object) -> bool:
        return super().__contains__(self.aliases.get(key, key) if isinstance(key, str) else key)

    def get(self, key: str, default: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the value of a key, by its old name too; the default if there is none."""
        try:
            return self[key]
        except KeyError:
            return default

    def copy(self) -> Self:
        """Return a dictionary of the same type with the same values."""
        return type(self)(self)

    def __or__(self, other: Mapping[str, Any]) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a dictionary of the same type with the values of both."""
        return type(self)({**self, **other})


def deprecated_module_names(module: str, **aliases: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a module for its old names, each of which is read with a `DeprecationWarning`.

    Args:
        module: its name. aliases: new names by old ones.
    """

    def get(name: str) -> Any:
        if name not in aliases:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(module, name, aliases[name])
        return getattr(sys.modules[module], aliases[name])

    return get


def _warn(owner: str, old: str, new: str) -> None:
    name = f"{owner}.{old}" if old else f"an old name in {owner}"
    warnings.warn(f"{name} is now {new}", DeprecationWarning, stacklevel=3)


def _equal(a: Any, b: Any) -> bool:
    """Return True if values are equal; arrays and tensors by shape and every element."""
    if getattr(a, "shape", None) != getattr(b, "shape", None):
        return False
    equal = a == b
    return bool(equal.all() if hasattr(equal, "all") else equal)
