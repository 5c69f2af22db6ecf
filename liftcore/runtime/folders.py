"""The user's cache folder, and temporary folders."""

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Return ``splatlift/NAME`` in the user's cache folder (XDG_CACHE_HOME), which may be emptied at any time."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "splatlift" / name


@contextmanager
def scratch_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """Create a folder in ``parent`` or the system's temporary folder, and remove it with its content afterwards."""
    with tempfile.TemporaryDirectory(dir=parent, prefix=prefix, ignore_cleanup_errors=True) as folder:
        yield Path(folder)
    if os.path.exists(folder):  # Windows keeps files that arrays still map
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
