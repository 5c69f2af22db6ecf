"""What runs here: versions, found without importing what they are of."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from liftcore import __version__
from service import wire
from service.store.schema import MIGRATIONS

API = "1"  # of the routes and their JSON: changes when a client that works today would break
PACKAGES = ("torch", "numpy", "numba", "fastapi", "uvicorn")


def versions(commit: str | None) -> wire.Version:
    """The versions; the commit is known only to whoever built this, and is told in the settings."""
    found = {name: _installed(name) for name in PACKAGES}
    return wire.Version(
        version=__version__,
        api=API,
        database=len(MIGRATIONS),
        commit=commit,
        python=platform.python_version(),
        packages={name: known for name, known in found.items() if known is not None},
    )


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
