"""The HTTP process's side of a check: start the process, wait for its report, end it in time."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput, InvalidMasks, InvalidSplats, InvalidTable
from service.errors import Busy, Crashed
from service.faults import error_of
from service.wire import AssetKind

TICK_SECONDS = 0.5  # how soon the end of the server is seen

INVALID: dict[AssetKind, type[InvalidInput]] = {
    AssetKind.SPLATS: InvalidSplats,
    AssetKind.CAMERAS: InvalidCameras,
    AssetKind.FEATURES: InvalidFeatures,
    AssetKind.MASKS: InvalidMasks,
    AssetKind.TABLE: InvalidTable,
}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CheckLimits:
    """What one check may take, and where it may unpack."""

    scratch: Path
    seconds: float
    memory_bytes: int
    ending: threading.Event  # set when the server must end, and every check with it


@dataclass(frozen=True)
class Report:
    """What a check found in a valid file."""

    suffix: str  # of the stored file, such as .ply
    counts: dict[str, Any]
    warnings: list[str]


def check(kind: AssetKind, path: Path, limits: CheckLimits) -> Report:
    """Read the whole file in a process of its own.

    Raises:
        InvalidInput: the file is malformed, or it takes more time or memory than it may.
        Crashed: the process did not get as far as opening the file.
        Busy: the server ended meanwhile.
    """
    command = [sys.executable, "-m", "service.uploads.check", kind, str(path), str(limits.memory_bytes)]
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(limits.scratch)},
    )
    with process:
        heard = _listen(process, limits)
        if heard is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if heard is not None:
        return _report(kind, heard[0], process.returncode, heard[1])
    if limits.ending.is_set():
        raise Busy("upload", expected="a running server", got="one that stops", hint="send it again")
    raise INVALID[kind](
        kind, expected=f"a file that is read within {limits.seconds:g} s", got="one that takes longer"
    )


def _listen(process: subprocess.Popen[bytes], limits: CheckLimits) -> tuple[bytes, bytes] | None:
    """What the process says on stdout and stderr until it ends; None when it must be ended."""
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (left := deadline - time.monotonic()) > 0:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=min(left, TICK_SECONDS))
    return None


def _report(kind: AssetKind, output: bytes, returncode: int, trace: bytes) -> Report:
    messages = [json.loads(line) for line in output.splitlines()]
    last: dict[str, Any] = messages[-1] if messages else {"event": "nothing"}
    if last["event"] == "valid":
        return Report(suffix=last["suffix"], counts=last["counts"], warnings=last["warnings"])
    if last["event"] == "invalid":
        raise error_of(last["fault"])
    log.error("the check of %s ended with %d: %s", kind, returncode, trace.decode(errors="replace")[-4000:])
    if last["event"] == "ready":
        # It had started to read: whatever ended it, this file did.
        raise INVALID[kind](
            kind, expected="a file that its reader can take", got=f"one that ended it with {returncode}",
            hint="it may be broken, or need more memory than an upload may take",
        )  # fmt: skip
    raise Crashed("check", expected="a process that starts", got=f"one that ended with {returncode}")
