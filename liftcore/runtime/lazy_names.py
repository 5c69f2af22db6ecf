"""Late imports: names of a package, as its stub lists them, and commands of the service, which may be missing."""

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

from liftcore.errors import Unavailable


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a module with a stub (``.pyi``) of imports beside its file.

    ``__all__`` is the stub's names, sorted, without ``__version__``.
    """

    @cache
    def read_stub() -> dict[str, str]:
        stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
        return {name: module for module, name in re.findall(r"(?m)^from (\S+) import (\w+)", stub)}

    def get(name: str) -> object:
        homes = read_stub()
        if name == "__all__":
            value: object = sorted(homes.keys() - {"__version__"})
        elif name in homes:
            value = getattr(import_module(homes[name]), name)
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        vars(sys.modules[package])[name] = value
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *read_stub()})

    return get, names


def load_command(name: str) -> ModuleType:
    """Import the module of a command of the service, where that is installed."""
    try:
        return import_module(f"service.commands.{name}")
    except ModuleNotFoundError as error:
        hint = "the package 'service' has it: pip install 'splatlift[service]', or run make setup in a checkout"
        raise Unavailable(repr(name), expected=f"the package {error.name}", got="none", hint=hint) from error
