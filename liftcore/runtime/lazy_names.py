"""Lazy import of a package's names, as its stub lists them."""

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path


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
