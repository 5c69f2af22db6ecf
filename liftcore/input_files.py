"""Which files a lift was made from: where they were, and what they were."""

from __future__ import annotations

import hashlib
from pathlib import Path

from liftcore.artifact import InputFile
from liftcore.scene.load import camera_files


def input_file(path: Path) -> InputFile:
    """Where an input is and what it is: the digest of the file, or of the names and digests of a folder's cameras.

    Photos, features and lifts that lie in the same folder do not count: they may come and go.
    """
    resolved = path.resolve()
    if not resolved.is_dir():
        return InputFile(path=str(resolved), sha256=sha256_of(resolved))
    total = hashlib.sha256()
    for part in camera_files(resolved):
        total.update(f"{part.relative_to(resolved)} {sha256_of(part)}\n".encode())
    return InputFile(path=str(resolved), sha256=total.hexdigest())


def sha256_of(path: Path) -> str:
    """The digest of a file, in hexadecimal digits."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
