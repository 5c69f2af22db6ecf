"""The HTTP process's side of a check: start the process, wait for its report, end it in time."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput, InvalidSplats
from service.errors import Crashed
from service.faults import error_of
from service.wire import AssetKind

INVALID: dict[AssetKind, type[InvalidInput]] = {
    AssetKind.SPLATS: InvalidSplats,
    AssetKind.CAMERAS: InvalidCameras,
    AssetKind.FEATURES: InvalidFeatures,
}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CheckLimits:
    """What one check may take, and where it may unpack."""

    scratch: Path
    seconds: float
    memory_bytes: int


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
        try:
            output, trace = process.communicate(timeout=limits.seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            raise INVALID[kind](
                kind, expected=f"a file that is read within {limits.seconds:g} s", got="one that takes longer"
            ) from None
    return _report(kind, output, process.returncode, trace)


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
