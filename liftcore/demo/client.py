"""The real service as a process of its own, and talk with it: uploads, a lift, questions, pictures."""

import os
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import httpx

from liftcore.errors import InvalidInput, SplatliftError, Unavailable

_PART = 1 << 20  # bytes of an upload sent at once
_POLL_SECONDS = 0.25
_TIMEOUT = httpx.Timeout(600.0, connect=10.0)  # the first query loads an encoder
_ENDED = ("succeeded", "failed", "canceled")


class Client:
    """One conversation. Answers of 4xx and 5xx become errors with the service's own words.

    Raises:
        InvalidInput: the service refused a request.
        Unavailable: it cannot be reached, or failed itself.
    """

    def __init__(self, url: str) -> None:
        # The service is on this machine: a proxy of the environment has no part in it.
        key = os.environ.get("SPLATLIFT_KEY")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=url, timeout=_TIMEOUT, trust_env=False, headers=headers)

    def close(self) -> None:
        """End the conversation."""
        self._http.close()

    def upload(self, kind: str, path: Path) -> dict[str, Any]:
        """``PUT /assets/KIND``: the asset, with its id and counts."""

        def parts() -> Iterator[bytes]:
            with path.open("rb") as handle:
                while part := handle.read(_PART):
                    yield part

        return self._call("PUT", f"/assets/{kind}", content=parts()).json()

    def lift(
        self, order: dict[str, Any], progress: Callable[[dict[str, Any]], None]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """``POST /lift`` and wait: the ended job and its lift."""
        job = self._call("POST", "/lift", json=order).json()
        while job["state"] not in _ENDED:
            progress(job)
            time.sleep(_POLL_SECONDS)
            job = self._call("GET", f"/jobs/{job['id']}").json()
        progress(job)
        if job["state"] != "succeeded":
            raise _refusal("lift", job.get("problem") or {}, job["state"])
        return job, self._call("GET", f"/lifts/{job['id']}").json()

    def ask(self, lift: str, text: str, **more: str) -> tuple[dict[str, Any], float]:
        """``GET /query``: the answer, and the milliseconds that it took to come."""
        begin = time.perf_counter()
        answer = self._call("GET", "/query", params={"lift": lift, "text": text, **more}).json()
        return answer, 1e3 * (time.perf_counter() - begin)

    def objects(self, lift: str, text: str) -> list[dict[str, Any]]:
        """``GET /query/objects``: the things that were found."""
        return self._call("GET", "/query/objects", params={"lift": lift, "text": text}).json()["objects"]

    def get(self, path: str, **parameters: str) -> dict[str, Any]:
        """Any other JSON of the service."""
        return self._call("GET", path, params=parameters).json()

    def picture(self, path: str, **parameters: str) -> tuple[bytes, float]:
        """A PNG of the service, and the milliseconds that it took to come."""
        begin = time.perf_counter()
        content = self._call("GET", path, params=parameters).content
        return content, 1e3 * (time.perf_counter() - begin)

    def _call(self, method: str, path: str, **how: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **how)
        except httpx.HTTPError as error:
            raise Unavailable("service", expected=f"an answer to {method} {path}", got=repr(error)) from None
        if response.is_success:
            return response
        kind = response.headers.get("content-type", "")
        problem = response.json() if "json" in kind else {"detail": response.text[:200]}
        raise _refusal(f"{method} {path}", problem, str(response.status_code))


def _refusal(what: str, problem: dict[str, Any], status: str) -> SplatliftError:
    """The service's problem as an error of ours: field by field where it has the fields, else its sentence."""
    kind = Unavailable if problem.get("status", 0) >= 500 else InvalidInput
    if problem.get("expected") and problem.get("got"):
        argument = problem.get("argument") or what
        return kind(argument, expected=problem["expected"], got=problem["got"], hint=problem.get("hint") or "")
    return kind(what, expected="success", got=problem.get("detail") or problem.get("title") or status)


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
