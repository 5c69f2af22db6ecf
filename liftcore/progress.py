"""How long work says where it is."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator


class Progress(Protocol):
    """Called as work advances: ``progress(stage, done, total, unit)``. May raise to stop the work."""

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        """Say that ``done`` of ``total`` units of ``stage`` are done."""
        ...


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """Say nothing."""


@contextmanager
def one_step(progress: Progress, stage: str) -> Iterator[None]:
    """Tell of the block as a stage without parts that could be counted."""
    progress(stage, 0, 1, "steps")
    yield
    progress(stage, 1, 1, "steps")
