"""The real service, as a process of its own."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from collections import deque
from typing import IO, TYPE_CHECKING, Self

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

_ANNOUNCEMENT = "listening on "
_START_SECONDS = 120.0  # a cold disk takes its time over the imports
_STOP_SECONDS = 20.0
_TAIL_LINES = 30


class Server:
    """Runs ``python -m service`` on a free port while the context is open; ``url`` says where.

    Raises:
        Unavailable: the service does not start; the message holds the end of its log.
    """

    def __init__(self, data: Path, encoder: str) -> None:
        self.url = ""
        self._command = [
            sys.executable, "-m", "service", "--port", "0", "--data", str(data), "--encoder", encoder,
        ]  # fmt: skip
        self._tail: deque[str] = deque(maxlen=_TAIL_LINES)
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._process: subprocess.Popen[str] | None = None
        self._readers: list[threading.Thread] = []

    def __enter__(self) -> Self:
        process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        self._process = process
        self._read(process.stdout, announce=True)
        self._read(process.stderr, announce=False)
        try:
            self.url = self._wait()
        except BaseException:
            self._stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    @property
    def log_tail(self) -> str:
        """The last lines that the service wrote."""
        return "\n".join(self._tail)

    def _read(self, stream: IO[str] | None, *, announce: bool) -> None:
        """Drain a pipe in a thread, so that the service never blocks on a full one."""
        if stream is None:
            return

        def drain() -> None:
            with stream:
                for line in stream:
                    self._tail.append(line.rstrip())
                    if announce:
                        self._lines.put(line)
            if announce:
                self._lines.put(None)

        reader = threading.Thread(target=drain, daemon=True)
        reader.start()
        self._readers.append(reader)

    def _wait(self) -> str:
        while True:
            try:
                line = self._lines.get(timeout=_START_SECONDS)
            except queue.Empty:
                raise self._failure(f"silence for {_START_SECONDS:.0f} s") from None
            if line is None:
                raise self._failure("an early end")
            if line.startswith(_ANNOUNCEMENT):
                return line.removeprefix(_ANNOUNCEMENT).strip()

    def _failure(self, got: str) -> Unavailable:
        return Unavailable(
            "service",
            expected="a service that starts",
            got=f"{got}; its last words: {self.log_tail or 'none'}",
        )

    def _stop(self) -> None:
        process = self._process
        if process is None:
            return
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for reader in self._readers:
            reader.join(_STOP_SECONDS)
