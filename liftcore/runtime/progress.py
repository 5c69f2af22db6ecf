"""Progress of long work, and the seconds of each of its stages."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any, Protocol

from liftcore.errors import InvalidSettings

LINE_SECONDS = 10.0  # between two lines of progress where nothing draws bars


class Progress(Protocol):
    """Function called as work advances: ``progress(stage, completed, total, unit)``. May raise to stop the work."""

    def __call__(self, stage: str, completed: int, total: int, unit: str, /) -> None:
        """Report that ``completed`` of ``total`` units of ``stage`` are complete."""


def silent(stage: str, completed: int, total: int, unit: str) -> None:
    """Report nothing."""


@contextmanager
def one_step(progress: Progress, stage: str) -> Iterator[None]:
    """Report the block as a stage of one step."""
    progress(stage, 0, 1, "steps")
    yield
    progress(stage, 1, 1, "steps")


class Timings:
    """Seconds of each stage of some work, which are reported to ``progress``."""

    def __init__(self, progress: Progress | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress: Progress = progress or silent
        self._within = 0.0  # seconds of stages within the one that runs

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the seconds of the block to that stage, without those of stages within it; report no progress."""
        start, before = time.perf_counter(), self._within
        self._within = 0.0
        yield
        seconds = time.perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds - self._within
        self._within = before + seconds

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time the block, and report it as one step."""
        with self.stage(name), one_step(self.progress, name):
            yield


@contextmanager
def shown_progress(progress: Progress | bool | None) -> Iterator[Progress]:
    """Yield the function that reports the progress of work to a caller.

    That is the caller's own; for True bars on a terminal and lines elsewhere, for None bars on a terminal alone.
    """
    if callable(progress):
        yield progress
    elif progress is not None and not isinstance(progress, bool):
        expected = "a function of (stage, completed, total, unit), True, False or None"
        raise InvalidSettings("progress", expected=expected, got=repr(progress)[:80])
    elif progress is not False and sys.stderr is not None and sys.stderr.isatty():
        with closing(_Bars()) as bars:
            yield bars
    else:
        yield _Lines() if progress else silent


class _Lines:
    """Progress as a line every LINE_SECONDS."""

    def __init__(self) -> None:
        self.next = time.monotonic() + LINE_SECONDS

    def __call__(self, stage: str, completed: int, total: int, unit: str) -> None:
        if time.monotonic() >= self.next:
            print(f"{stage}: {completed} of {total} {unit}", file=sys.stderr, flush=True)
            self.next = time.monotonic() + LINE_SECONDS


class _Bars:
    """Progress as one bar of tqdm a stage."""

    stage = ""
    bar: Any = None

    def __call__(self, stage: str, completed: int, total: int, unit: str) -> None:
        if self.bar is None or stage != self.stage:
            from tqdm import tqdm

            self.close()
            self.stage = stage
            options = {"leave": total > 1, "file": sys.stderr, "dynamic_ncols": True}
            self.bar = tqdm(total=total, desc=stage, unit=f" {unit}", **options)
        self.bar.total = total
        self.bar.update(completed - self.bar.n)
        if completed >= total == 1:  # one step is shown while it lasts: the plan is printed where its bar was
            self.close()

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None
