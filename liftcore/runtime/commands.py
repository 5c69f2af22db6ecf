"""Commands of the package ``service``, and the page of a lift, which this package starts and never imports."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from liftcore.errors import Unavailable


def load_command(name: str) -> ModuleType:
    """Import the module of a command of the service, where that is installed."""
    try:
        return import_module(f"service.commands.{name}")
    except ModuleNotFoundError as error:
        hint = "the package 'service' has it: pip install 'splatlift[service]', or run make setup in a checkout"
        raise Unavailable(repr(name), expected=f"the package {error.name}", got="none", hint=hint) from error
