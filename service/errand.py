"""A short task in a process of its own: heard to its end, or ended in time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import Busy

TICK_SECONDS = 0.5  # how soon the end of the server is seen by who waits


@dataclass(frozen=True)
class ErrandLimits:
    """What one task may take."""

    seconds: float
    memory_bytes: int  # whatever its size
    ending: threading.Event  # set when the server must end, and every task with it


@dataclass(frozen=True)
class Heard:
    """What a task said until it ended."""

    last: dict[str, Any]  # its last message; {"event": "nothing"} when there was none
    returncode: int
    trace: str  # its standard error


def run_errand(module: str, arguments: Sequence[str], scratch: Path, limits: ErrandLimits) -> Heard | None:
    """Run ``python -m module`` to its end.

    Args:
        module: what to run; it says JSON lines on its stdout, and ends when its stdin closes.
        arguments: of its command line.
        scratch: the folder for its temporary files.
        limits: of them the time is kept here, the memory by the task itself.

    Returns:
        What it said; None when it took longer than it may, and was ended.

    Raises:
        Busy: the server ended meanwhile.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=subprocess.PIPE,  # its lifeline
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(scratch)},
    )
    with process:
        heard = _listen(process, limits)
        if heard is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if heard is not None:
        messages = [json.loads(line) for line in heard[0].splitlines()]
        last = messages[-1] if messages else {"event": "nothing"}
        return Heard(last, process.returncode, heard[1].decode(errors="replace"))
    if limits.ending.is_set():
        raise Busy("upload", expected="a running server", got="one that stops", hint="send it again")
    return None


def _listen(process: subprocess.Popen[bytes], limits: ErrandLimits) -> tuple[bytes, bytes] | None:
    """What the process says on stdout and stderr until it ends; None when it must be ended."""
    assert process.stdout is not None and process.stderr is not None
    said: dict[str, bytes] = {}
    pipes = {"out": process.stdout, "error": process.stderr}
    # Not `communicate`, which closes stdin first.
    readers = [
        threading.Thread(target=lambda name=name, pipe=pipe: said.update({name: pipe.read()}), daemon=True)
        for name, pipe in pipes.items()
    ]
    for reader in readers:
        reader.start()
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (left := deadline - time.monotonic()) > 0:
        readers[0].join(min(left, TICK_SECONDS))
        if not readers[0].is_alive():
            readers[1].join()
            process.wait()
            return said["out"], said["error"]
    return None
