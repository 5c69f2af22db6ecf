"""``splatlift keys``: the keys of the HTTP service, in a process of the service's own."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    import argparse

_OPTIONS = ("name", "scopes", "max_bytes", "max_queued", "max_uploads", "data")


def run(options: argparse.Namespace) -> int:
    """Become ``python -m service.keys``; the library itself knows neither HTTP nor its database."""
    if find_spec("service") is None:
        raise Unavailable("keys", expected="the package 'service'", got="an installation without it")
    arguments = [options.action]
    for name in _OPTIONS:
        value = getattr(options, name, None)
        if value is not None:
            arguments.append(f"--{name.replace('_', '-')}={value}")
    arguments += ["--json"] if options.json else []
    arguments += ["--", options.id] if options.action == "revoke" else []
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", "service.keys", *arguments])
