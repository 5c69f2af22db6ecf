"""Memory that is no file's is watched while it is held."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from liftcore.evaluate import anonymous_memory
from liftcore.evaluate.anonymous_memory import Most, anonymous_bytes, watched

SIZE = 1 << 27


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells what of a process is no file's")
def test_what_was_held_and_given_back_is_in_the_most() -> None:
    before = anonymous_bytes()
    assert before is not None
    assert before == pytest.approx(anonymous_bytes(os.getpid()), rel=0.2)
    with watched() as most:
        held = np.ones(SIZE, np.uint8)
        for _ in range(500):  # the watch looks every few milliseconds, beside others that work
            if most.bytes and most.bytes > before + 0.9 * SIZE:
                break
            time.sleep(0.01)
        del held
    assert most.bytes is not None
    assert 0.9 * SIZE < most.bytes - before < 2 * SIZE


def test_nothing_is_told_of_a_process_that_has_ended() -> None:
    assert anonymous_bytes(2**22 + 1) is None


def test_where_nothing_tells_the_most_is_not_known(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(anonymous_memory, "Path", lambda _: tmp_path / "nothing")
    with watched() as most:
        pass
    assert most.bytes is None
    most = Most(5)
    most.take(None)
    most.take(3)
    assert most.bytes == 5
