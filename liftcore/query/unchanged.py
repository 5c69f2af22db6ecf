"""Whether the files that a lift was made from are still what they were."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import InvalidLift

if TYPE_CHECKING:
    from liftcore.artifact import InputFile

_READ = 1 << 20  # bytes read at once


def unchanged(role: str, remembered: InputFile, lift: Path) -> Path:
    """The path of an input, once its bytes are known to be those that were lifted.

    Args:
        role: what the input is, for the message: ``splats`` or ``cameras``.
        remembered: where it was at lift time, and its SHA-256.
        lift: the lift file that remembers it.

    Raises:
        InvalidLift: nothing is there any more, or something else is.
    """
    path = Path(remembered.path)
    if not path.exists():
        raise InvalidLift(
            str(lift),
            expected=f"its {role} at {path}",
            got="nothing there",
            hint=f"move the {role} back to {path}, or lift again from where they are now",
        )
    if digest(path) != remembered.sha256:
        raise InvalidLift(
            str(lift),
            expected=f"the {role} that were lifted at {path}",
            got="a file with another SHA-256",
            hint=f"the {role} changed since the lift: restore them, or lift again",
        )
    return path


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes; for a folder, of the sorted lines ``name digest`` of its files."""
    if path.is_dir():
        lines = sorted(f"{file.name} {digest(file)}" for file in path.iterdir() if file.is_file())
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()
    total = hashlib.sha256()
    with path.open("rb") as handle:
        while part := handle.read(_READ):
            total.update(part)
    return total.hexdigest()
