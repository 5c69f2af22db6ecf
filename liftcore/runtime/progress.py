"""How long work says where it is, and how many seconds each of its stages took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


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


class Timings:
    """Seconds of each stage of a piece of work, of which ``progress`` is told."""

    def __init__(self, progress: Progress | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress: Progress = progress or silent
        self._within = 0.0  # seconds of stages within the one that runs

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block, which tells of itself, under that name; without the stages within it."""
        start, before = time.perf_counter(), self._within
        self._within = 0.0
        yield
        seconds = time.perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds - self._within
        self._within = before + seconds

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time the block, and tell of it as one step."""
        with self.stage(name), one_step(self.progress, name):
            yield
