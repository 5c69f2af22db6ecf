"""Shared parts of child processes: messages, errors as JSON, and their end with the server."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from liftcore.errors import SplatliftError

FIELDS = ("argument", "expected", "got", "hint")
PIECE = 1 << 16
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # set before numeric libraries are loaded
ORPHANED = 3  # exit status of a process whose server has ended


def own_stdout() -> BinaryIO:
    """Return the pipe to the parent process, for messages only; what libraries print goes to stderr from now on."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return out


def line_of(message: Mapping[str, Any]) -> bytes:
    """Return a message as a line of UTF-8 JSON, without escapes: they would triple names in other scripts."""
    return json.dumps(message, ensure_ascii=False).encode("utf-8", "surrogatepass") + b"\n"


class Messages:
    """JSON lines that another process writes to a pipe.

    Args:
        pipe: its file number, whose closing is the caller's.
    """

    def __init__(self, pipe: int) -> None:
        self.open = True  # False once the other end of the pipe is closed
        self._pipe = pipe
        self._poll = select.poll()  # not select(), which refuses file numbers above 1023
        self._poll.register(pipe, select.POLLIN)
        self._rest: list[bytes] = []  # pieces of an incomplete line
        os.set_blocking(pipe, False)

    def read(self, seconds: float) -> list[dict[str, Any]]:
        """Return the messages so far; return at the first line, at the end of the pipe, or after `seconds`."""
        if not self.open:
            time.sleep(seconds)
            return []
        if not self._poll.poll(seconds * 1000):
            return []
        lines: list[bytes] = []
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._pipe, PIECE):
                first, *rest = piece.split(b"\n")
                self._rest.append(first)
                for piece_after in rest:  # joined once per line: a message may hold a hundred thousand names
                    lines.append(b"".join(self._rest))
                    self._rest = [piece_after]
            self.open = False  # a killed writer may leave an incomplete line at the end
        return [json.loads(line) for line in lines]


def end_with_parent(lifeline: int) -> None:
    """End this process, and the group that it leads, when the other end of a pipe closes: the server has ended.
    On Linux a signal of the kernel does it, even within a call that no thread could interrupt.

    Args:
        lifeline: the file number of a pipe that nothing is written to.
    """
    group = os.getpgrp() == os.getpid()  # the server made us the leader of a group of our own
    if sys.platform == "linux":
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid() if group else os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)

    def wait() -> None:  # on other systems, and if the pipe closed before
        os.read(lifeline, 1)
        if group:
            os.killpg(0, signal.SIGKILL)
        os._exit(ORPHANED)

    threading.Thread(target=wait, daemon=True).start()


def children_of(process: int) -> list[int]:
    """Return the ids of the children of a process that have not been waited for, as Linux reports them."""
    children = list[int]()
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():  # a process is a child of the thread that started it
            with contextlib.suppress(OSError):
                children += map(int, (task / "children").read_text().split())
    return children


def memory_of(process: int | str, field: str) -> int:
    """Return bytes that Linux reports for a process, by number or ``self``; 0 if it reports none.

    Args:
        field: ``RssAnon``, what is in memory but for mapped files; ``VmData``, what RLIMIT_DATA limits.
    """
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith(f"{field}:"):
                return int(line.split()[1]) << 10
    return 0


def is_stopped(process: int) -> bool:
    """Return True if a process is stopped (SIGSTOP), as Linux reports it: it lives and does not respond."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in ("T", "t")
    return False


def fault_of(error: SplatliftError, names: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the error as JSON: kind, argument, expected, got, hint; for an unknown word also the nearest ones.

    Args:
        error: the error to send.
        names: server path -> the name that the client knows: paths of the server are private.
    """
    fault = {name: str(getattr(error, name)) for name in FIELDS}
    document: dict[str, Any] = {"kind": error.kind}
    document |= {field: replace_names(text, names or {}) for field, text in fault.items()}
    return document if error.nearest is None else document | {"nearest": error.nearest}


def replace_names(text: str, names: Mapping[str, str]) -> str:
    """Return a text with server paths replaced by the names that the client knows."""
    for path, name in names.items():
        text = text.replace(path, name)
    return text


def error_of(fault: Mapping[str, Any]) -> SplatliftError:
    """Return the error that `fault_of` encoded; an unknown kind becomes the base class."""
    kinds = {cls.kind: cls for cls in reversed(_tree(SplatliftError))}  # of two with one kind the base class counts
    cls = kinds.get(fault["kind"], SplatliftError)
    error = cls(fault["argument"], expected=fault["expected"], got=fault["got"], hint=fault["hint"])
    error.nearest = tuple(fault["nearest"]) if "nearest" in fault else None
    return error


def _tree(cls: type[SplatliftError]) -> list[type[SplatliftError]]:
    return [cls, *(descendant for child in cls.__subclasses__() for descendant in _tree(child))]
