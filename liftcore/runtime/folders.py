"""Folders of the user that runs this."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """``splatlift/NAME`` in the user's cache folder (XDG_CACHE_HOME), which may be emptied at any time."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "splatlift" / name
