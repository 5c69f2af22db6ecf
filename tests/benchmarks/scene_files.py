"""Where the files of a scene folder lie."""

from __future__ import annotations

from pathlib import Path


def cameras_of(folder: Path) -> Path:
    """What `read_cameras` and a lift read the cameras from: ``cameras.json`` if it is there, else the folder."""
    inria = folder / "cameras.json"
    return inria if inria.is_file() else folder
