"""How long work says where it is, and how many seconds each of its stages took."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from liftcore.errors import InvalidSettings

LINE_SECONDS = 10.0  # between two lines of progress where nothing draws bars


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


@contextmanager
def shown_progress(progress: Progress | bool | None) -> Iterator[Progress]:
    """Give what a caller of the library wants to see of the work.

    Args:
        progress: a function that is called as work advances; True for bars on a terminal and lines elsewhere; False
            for nothing; None for bars on a terminal and nothing elsewhere.

    Raises:
        InvalidSettings: it is something else.
    """
    if progress is None:
        progress = sys.stderr is not None and sys.stderr.isatty()
    if callable(progress):
        yield progress
    elif progress is False:
        yield silent
    elif progress is True:
        with progress_bars() as bars:
            yield bars
    else:
        expected = "a function of (stage, done, total, unit), True, False or None"
        raise InvalidSettings("progress", expected=expected, got=repr(progress)[:80])


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Yield progress that draws one bar a stage on a terminal; elsewhere it says a line every ten seconds."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    bars = _Bars()
    try:
        yield bars
    finally:
        bars.close()


class _Lines:
    """A line every LINE_SECONDS."""

    def __init__(self) -> None:
        self.next = time.monotonic() + LINE_SECONDS

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if time.monotonic() >= self.next:
            print(f"{stage}: {done} of {total} {unit}", file=sys.stderr, flush=True)
            self.next = time.monotonic() + LINE_SECONDS


class _Bars:
    """One bar a stage, of tqdm."""

    def __init__(self) -> None:
        self.stage = ""
        self.bar: Any = None

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if self.bar is None or stage != self.stage:
            from tqdm import tqdm

            self.close()
            self.stage = stage
            look = {"leave": total > 1, "file": sys.stderr, "dynamic_ncols": True}
            self.bar = tqdm(total=total, desc=stage, unit=f" {unit}", **look)
        self.bar.total = total
        self.bar.update(done - self.bar.n)
        if done >= total == 1:  # one step is shown while it lasts: the plan is printed where its bar was
            self.close()

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None
