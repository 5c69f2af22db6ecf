"""Folders of the user that runs this, and folders for a while."""

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def cache_folder(name: str) -> Path:
    """``splatlift/NAME`` in the user's cache folder (XDG_CACHE_HOME), which may be emptied at any time."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "splatlift" / name


@contextmanager
def scratch_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """Make a folder that is removed afterwards, with what lies in it.

    Windows keeps files that arrays still map: there they go when the process ends.

    Args:
        parent: where to make it; None: the system's temporary folder.
    """
    with tempfile.TemporaryDirectory(dir=parent, prefix=prefix, ignore_cleanup_errors=True) as folder:
        yield Path(folder)
    if os.path.exists(folder):
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
