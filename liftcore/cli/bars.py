"""Progress bars on stderr, and only for somebody who watches."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from liftcore.progress import Progress, silent

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Progress that draws one bar a stage on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield silent
        return
    bars = _Bars()
    try:
        yield bars
    finally:
        bars.close()


class _Bars:
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
