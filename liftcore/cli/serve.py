"""``splatlift serve``: the HTTP service, in place of this process."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    import argparse

_OPTIONS = ("host", "port", "data", "encoder")


def run(options: argparse.Namespace) -> int:
    """Become the service; the library itself knows no HTTP, so it is started by name."""
    if find_spec("service") is None:
        raise Unavailable("serve", expected="the package 'service'", got="an installation without it")
    given = {name: getattr(options, name) for name in _OPTIONS}
    arguments = [part for name, value in given.items() if value is not None for part in (f"--{name}", str(value))]
    if options.json:
        arguments.append("--json")
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", "service", *arguments])
