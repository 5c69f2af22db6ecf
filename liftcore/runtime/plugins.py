"""Entry points of the service: commands, and the page of a lift, which this package starts and never imports."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from liftcore.errors import Unavailable

Group = Literal["splatlift.commands", "splatlift.viewers"]
INSTALL = "the package 'service' has it: pip install 'splatlift[service]', or run make setup in a checkout"


def load_plugin(group: Group, name: str) -> Any:
    """Import the object of an entry point.

    Raises:
        Unavailable: no package has it, or a package that it needs is missing.
    """
    entry = next((entry for entry in _entries(group) if entry.name == name), None)
    if entry is None:
        expected = f"a package with an entry point of that name in {group}"
        raise Unavailable(repr(name), expected=expected, got="none installed", hint=INSTALL)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        raise Unavailable(repr(name), expected=f"the package {error.name}", got="none", hint=INSTALL) from error


def _entries(group: Group) -> list[EntryPoint]:
    entries = [entry for entry in _of_checkout() if entry.group == group]
    return entries or [entry for entry in entry_points(group=group) if entry.dist and entry.dist.name == "splatlift"]


@cache
def _of_checkout() -> tuple[EntryPoint, ...]:
    """Return the entry points of this checkout, whose installation may be older or missing."""
    path = Path(__file__).parents[2] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8")).get("project", {}) if path.is_file() else {}
    groups = project.get("entry-points", {}) if project.get("name") == "splatlift" else {}
    return tuple(EntryPoint(name, value, group) for group in groups for name, value in groups[group].items())
