"""How long work says where it is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called as work advances: ``progress(stage, done, total, unit)``. May raise to stop the work."""

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        """Say that ``done`` of ``total`` units of ``stage`` are done."""
        ...


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """Say nothing."""
