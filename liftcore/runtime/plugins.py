"""Plugins: formats and encoders of other packages and commands of the service, as entry points of a distribution.

    [project.entry-points."splatlift.text_encoders"]
    mine = "my_package:open_encoder"

Built-in names come first, and no entry point replaces them. A plugin is imported at the first use of its name.
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
    """An entry point of a package."""

    entry: EntryPoint

    @property
    def value(self) -> str:
        """The plugin's name and package, for messages and reports."""
        package = self.entry.dist.name if self.entry.dist else self.entry.module
        return f"{self.entry.name!r} of the package {package}"

    def call(self, *arguments: Any, needs: Collection[str]) -> Any:
        """Import the object and call it.

        Args:
            needs: attributes that the result must have.

        Raises:
            Unavailable: it does not import, raises an error that is not splatlift's, or its result lacks an
                attribute.
        """
        with self._errors():
            result = self.entry.load()(*arguments)
        missing = [name for name in needs if not hasattr(result, name)]
        if missing:
            got = f"{type(result).__name__} without {', '.join(missing)}"
            raise Unavailable(f"plugin {self.value}", expected=f"a value with {', '.join(needs)}", got=got)
        return result

    def load(self) -> Any:
        """Import the object.

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
            # An error of code outside of splatlift.
            got = f"{type(error).__name__}: {error}"[:160]
            hint = f"check that {self.entry.value} imports and runs by itself, or remove the package"
            raise Unavailable(f"plugin {self.value}", expected="a working plugin", got=got, hint=hint) from error


def load_plugin(group: Group, name: str) -> Any:
    """Import the plugin of that name.

    Raises:
        Unavailable: no package has it, two have it, or it does not import.
    """
    plugin = find_plugin(group, name)
    if plugin is None:
        expected = f"a package with an entry point of that name in {group}"
        hint = "the package 'service' has it: pip install 'splatlift[service]', or run make setup in a checkout"
        is_own_group = group in ("splatlift.commands", "splatlift.viewers")
        raise Unavailable(repr(name), expected=expected, got="none installed", hint=hint if is_own_group else "")
    return plugin.load()


def find_plugin(group: Group, name: str, built_in: Collection[str] = ()) -> Plugin | None:
    """Return the plugin of that name, or None if no package has one.

    Args:
        built_in: names of splatlift itself; plugins of these names are ignored, with a warning.

    Raises:
        Unavailable: two packages have it.
    """
    for ignored in sorted(set(built_in).intersection(plugin_names(group))):
        _warn(group, ignored)
    plugins = [Plugin(entry) for entry in _entries(group) if entry.name == name and name not in built_in]
    if len(plugins) > 1:
        packages = " and ".join(plugin.value for plugin in plugins)
        hint = "uninstall one of them"
        raise Unavailable(f"plugin {name!r}", expected=f"one package per name in {group}", got=packages, hint=hint)
    return plugins[0] if plugins else None


def plugin_names(group: Group) -> list[str]:
    """Return the names of all plugins, sorted."""
    return sorted({entry.name for entry in _entries(group)})


def _entries(group: Group) -> tuple[EntryPoint, ...]:
    entries = entry_points(group=group)
    own_entries = [entry for entry in _of_checkout() if entry.group == group]
    own_entries = own_entries or [entry for entry in entries if entry.dist and entry.dist.name == "splatlift"]
    names = {entry.name for entry in own_entries}  # of splatlift, which no other package replaces
    other_entries = [entry for entry in entries if entry.name not in names]
    visible = [*own_entries, *other_entries]
    return tuple(sorted(visible, key=lambda entry: (entry.name, entry.dist.name if entry.dist else "")))


@cache
def _of_checkout() -> tuple[EntryPoint, ...]:
    """Return the entry points of this checkout, whose installation may be older or missing."""
    path = Path(__file__).parents[2] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8")).get("project", {}) if path.is_file() else {}
    groups = project.get("entry-points", {}) if project.get("name") == "splatlift" else {}
    return tuple(EntryPoint(name, value, group) for group in groups for name, value in groups[group].items())


@cache
def _warn(group: Group, name: str) -> None:
    for entry in _entries(group):
        if entry.name == name:
            log.warning("plugin %s is ignored: splatlift has a built-in %r", Plugin(entry).value, name)
