"""How an error crosses from a child process to the HTTP process: as a flat JSON object."""

from __future__ import annotations

from collections.abc import Mapping

from liftcore.errors import SplatliftError

FIELDS = ("argument", "expected", "got", "hint")


def fault_of(error: SplatliftError, names: Mapping[str, str] | None = None) -> dict[str, str]:
    """The error as JSON: kind, argument, expected, got, hint.

    Args:
        error: the error to send.
        names: server path -> the name that the client knows; paths of this machine are nobody's business.
    """
    fault = {name: str(getattr(error, name)) for name in FIELDS}
    return {"kind": error.kind} | {field: renamed(text, names or {}) for field, text in fault.items()}


def renamed(text: str, names: Mapping[str, str]) -> str:
    """A text in which server paths have the names that the client knows."""
    for path, name in names.items():
        text = text.replace(path, name)
    return text


def error_of(fault: Mapping[str, str]) -> SplatliftError:
    """The error that `fault_of` told of; an unknown kind becomes the base class."""
    kinds = {cls.kind: cls for cls in _tree(SplatliftError)}
    cls = kinds.get(fault["kind"], SplatliftError)
    return cls(fault["argument"], expected=fault["expected"], got=fault["got"], hint=fault["hint"])


def _tree(cls: type[SplatliftError]) -> list[type[SplatliftError]]:
    return [cls, *(found for child in cls.__subclasses__() for found in _tree(child))]
