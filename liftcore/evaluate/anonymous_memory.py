"""Memory of a process that is no file's: mapped files count as resident, though the system takes their pages back."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

PAUSE = 0.003  # seconds between two looks


@dataclass
class Most:
    """The most bytes of all looks; None where nothing tells them, as Linux alone does."""

    bytes: int | None = None

    def take(self, found: int | None) -> None:
        """Another look."""
        if found is not None:
            self.bytes = max(self.bytes or 0, found)


def anonymous_bytes(process: int | str = "self") -> int | None:
    """What a process holds now; None where it has ended, or nothing tells."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:")), None)


@contextmanager
def watched() -> Iterator[Most]:
    """The most that this process holds while the block runs."""
    most, ended = Most(), threading.Event()

    def look() -> None:
        while not ended.wait(PAUSE):
            most.take(anonymous_bytes())

    watch = threading.Thread(target=look, daemon=True)
    most.take(anonymous_bytes())
    watch.start()
    try:
        yield most
    finally:
        most.take(anonymous_bytes())
        ended.set()
        watch.join()
