"""Which files a lift was made from: where they were, and what they were."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.io.cameras import camera_source
from liftcore.result import InputFile

if TYPE_CHECKING:
    from collections.abc import Sequence


def input_files(splats: Path, cameras: Path, features: Sequence[Path]) -> list[InputFile]:
    """The inputs of a lift: splats, cameras and feature packs."""
    return [input_file(splats), camera_input(cameras), *(input_file(pack) for pack in features)]


def input_file(path: Path) -> InputFile:
    """Where a file is, and its digest."""
    resolved = path.resolve()
    return InputFile(path=str(resolved), sha256=sha256_of(resolved))


def camera_input(path: Path) -> InputFile:
    """Where cameras are, and the digest of their file or, of several, of the names and digests of all that are read.

    Photos, features and lifts that lie in the same folder do not count: they may come and go.
    """
    given = Path(os.path.abspath(path))  # links stay: other files count beside them than where they lead
    files = camera_source(given).files
    if files == [given]:
        return InputFile(path=str(given), sha256=sha256_of(given))
    folder, total = given if given.is_dir() else given.parent, hashlib.sha256()
    for part in files:
        total.update(f"{os.path.relpath(part, folder)} {sha256_of(part)}\n".encode())
    return InputFile(path=str(given), sha256=total.hexdigest())


def sha256_of(path: Path) -> str:
    """The digest of a file, in hexadecimal digits."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
