"""Formats and encoders of other packages and commands of the service, announced as entry points of a distribution.

    [project.entry-points."splatlift.text_encoders"]
    mine = "my_package:open_encoder"

What splatlift brings itself comes first, and no entry point takes its place. A plugin is imported when its name is
asked for, never before.
"""

from __future__ import annotations

import logging
import tomllib
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from liftcore.errors import SplatliftError, Unavailable

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

Group = Literal[
    "splatlift.splat_formats",
    "splatlift.text_encoders",
    "splatlift.image_encoders",
    "splatlift.commands",
    "splatlift.viewers",
]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plugin:
    """What a package announces under a name."""

    entry: EntryPoint

    @property
    def value(self) -> str:
        """The name and the package, for messages and reports."""
        package = self.entry.dist.name if self.entry.dist else self.entry.module
        return f"{self.entry.name!r} of the package {package}"

    def call(self, *arguments: Any, needs: Collection[str]) -> Any:
        """Call what it announces.

        Args:
            needs: attributes that the answer must have.

        Raises:
            Unavailable: it does not import, fails with an error that is none of splatlift's, or gives something else.
        """
        with self._errors():
            made = self.entry.load()(*arguments)
        missing = [name for name in needs if not hasattr(made, name)]
        if missing:
            got = f"{type(made).__name__} without {', '.join(missing)}"
            raise Unavailable(f"plugin {self.value}", expected=f"a value with {', '.join(needs)}", got=got)
        return made

    def load(self) -> Any:
        """Import the object that it announces.

        Raises:
            Unavailable: it does not import.
        """
        with self._errors():
            return self.entry.load()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except SplatliftError:
            raise
        except Exception as error:
            if isinstance(error, ModuleNotFoundError) and self.entry.module.startswith("service."):
                raise Unavailable(
                    repr(self.entry.name),
                    expected=f"the package {error.name}",
                    got="none",
                    hint="pip install 'splatlift[service]'",
                ) from error
            # of code that is not ours
            got = f"{type(error).__name__}: {error}"[:160]
            hint = f"see whether {self.entry.value} imports and runs alone, or remove the package"
            raise Unavailable(f"plugin {self.value}", expected="one that works", got=got, hint=hint) from error


def load_plugin(group: Group, name: str) -> Any:
    """Import what a package announces under that name, for what splatlift does not do itself.

    Raises:
        Unavailable: none does, two do, or it does not import.
    """
    plugin = find_plugin(group, name)
    if plugin is None:
        expected = f"a package with an entry point of that name in {group}"
        hint = "splatlift's package 'service' has it: pip install 'splatlift[service]', or make setup in a checkout"
        own = group in ("splatlift.commands", "splatlift.viewers")
        raise Unavailable(repr(name), expected=expected, got="none installed", hint=hint if own else "")
    return plugin.load()


def find_plugin(group: Group, name: str, built_in: Collection[str] = ()) -> Plugin | None:
    """What a package announces under that name, or None where none does.

    Args:
        built_in: names that splatlift has itself; plugins of these are ignored, with a warning.

    Raises:
        Unavailable: two packages announce it.
    """
    for taken in sorted(set(built_in).intersection(plugin_names(group))):
        _warn(group, taken)
    found = [Plugin(entry) for entry in _entries(group) if entry.name == name and name not in built_in]
    if len(found) > 1:
        both = " and ".join(plugin.value for plugin in found)
        hint = "uninstall one of them"
        raise Unavailable(f"plugin {name!r}", expected=f"one package for a name in {group}", got=both, hint=hint)
    return found[0] if found else None


def plugin_names(group: Group) -> list[str]:
    """The names that packages announce, sorted."""
    return sorted({entry.name for entry in _entries(group)})


def _entries(group: Group) -> tuple[EntryPoint, ...]:
    found = entry_points(group=group)
    own = [entry for entry in _of_checkout() if entry.group == group]
    own = own or [entry for entry in found if entry.dist is not None and entry.dist.name == "splatlift"]
    names = {entry.name for entry in own}  # which no other package takes
    others = [entry for entry in found if entry.name not in names]
    return tuple(sorted([*own, *others], key=lambda entry: (entry.name, entry.dist.name if entry.dist else "")))


@cache
def _of_checkout() -> tuple[EntryPoint, ...]:
    """Entry points of the checkout that this file lies in, whose installation may be older, or not there."""
    path = Path(__file__).parents[2] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8")).get("project", {}) if path.is_file() else {}
    groups = project.get("entry-points", {}) if project.get("name") == "splatlift" else {}
    return tuple(EntryPoint(name, value, group) for group in groups for name, value in groups[group].items())


@cache
def _warn(group: Group, name: str) -> None:
    for entry in _entries(group):
        if entry.name == name:
            log.warning("plugin %s is ignored: splatlift has a %r of its own", Plugin(entry).value, name)
