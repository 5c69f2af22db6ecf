"""What a data directory remembers outside its database, so that an empty or older database is known as one."""

from __future__ import annotations

from pathlib import Path

from liftcore.io.files import whole_file
from service.errors import Misconfigured
from service.store.files import sync_directory

GENERATION = "generation"  # the number that the newest counted transaction had
KEYS_REQUIRED = "keys.required"  # there when a key was ever made


def expected_generation(data: Path) -> int | None:
    """The least generation that the database of a data directory has; None when a new one does no harm.

    Raises:
        Misconfigured: the marker is there and holds no number.
    """
    marked = _marked(data)
    if marked is None and (any(data.glob("blobs/*/*")) or any(data.glob("lifts/*"))):
        return 0  # files of a release without the marker
    return marked


def remember_generation(data: Path, number: int) -> None:
    """Keep the number of a transaction that is on the disk; a larger one, of another process, stays."""
    if (_marked(data) or 0) < number:
        _write(data / GENERATION, f"{number}\n")


def keys_were_made(data: Path) -> bool:
    """Whether there ever was a key."""
    return (data / KEYS_REQUIRED).exists()


def remember_keys(data: Path) -> None:
    """Keep that there is a key."""
    if not keys_were_made(data):
        _write(data / KEYS_REQUIRED, "A key was made for this data directory: without one nobody is let in.\n")


def _marked(data: Path) -> int | None:
    path = data / GENERATION
    try:
        return int(path.read_text("ascii"))
    except FileNotFoundError:
        return None
    except ValueError:
        raise Misconfigured(
            "data", expected="a whole number in the file 'generation'", got=f"something else at {path}",
            hint="remove it, if the database is the newest one",
        ) from None  # fmt: skip


def _write(path: Path, text: str) -> None:
    with whole_file(path) as handle:
        handle.write(text.encode())
    sync_directory(path.parent)
