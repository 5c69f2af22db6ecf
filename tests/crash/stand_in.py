"""Stand-in for the process of a job: behaves as requested, without the seconds that a lift takes to begin.

    python stand_in.py BEHAVIOUR ORDER

It talks as ``service.job_child`` does. A lift of it is its job's inputs, digested; what it needs to know of earlier
attempts lies in its work folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def say(**message: Any) -> None:
    print(json.dumps(message), flush=True)


def finish(order: dict[str, Any]) -> None:
    if order["kind"] == "tradeoff":
        Path(order["output"]).write_bytes(b"a chart")
        document = {"runs": [], "over_budget": [], "choice": {}, "views": {}, "seconds": 0.0, **order["parameters"]}
        say(event="done", document=document, page="a table")
        return
    content = hashlib.sha256(json.dumps([order["splats"], order["settings"]]).encode()).digest()
    Path(order["output"]).write_bytes(content)
    names = {"encoder": "", "text_space": "none", "views": []}
    metadata = {"version": "0", "settings": {}, "diagnostics": {}, "timings": {}, **names}
    sha256 = hashlib.sha256(content).hexdigest()
    say(event="done", sha256=sha256, count=1, channels=1, metadata=metadata)


def first_time(order: dict[str, Any]) -> bool:
    work = Path(order["work"])
    work.mkdir(parents=True, exist_ok=True)
    attempts = work / "attempts"
    before = attempts.read_text().split() if attempts.exists() else []
    attempts.write_text(" ".join([*before, str(os.getpid())]))
    return not before


def plan(line: str) -> None:
    say(event="plan", plan={"summary": [line], "warnings": [], "splats": 1})


def answer(order: dict[str, Any]) -> None:
    plan("one splat")
    say(event="progress", stage="geometry", completed=0, total=2, unit="views")
    say(event="progress", stage="geometry", completed=1, total=2, unit="views")
    say(event="progress", stage="solve", completed=1, total=1, unit="slices")
    finish(order)


def hang(order: dict[str, Any]) -> None:
    plan("a long time")
    first_time(order)
    child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
    (Path(order["work"]) / "grandchild").write_text(str(child.pid))
    while True:
        say(event="beat")
        time.sleep(0.1)


def die(order: dict[str, Any]) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(order: dict[str, Any]) -> None:
    if first_time(order):
        plan("to die")
        die(order)
    answer(order)


def stop_once(order: dict[str, Any]) -> None:
    if first_time(order):
        os.kill(os.getpid(), signal.SIGSTOP)  # and if it is ever continued, it claims to be done
    answer(order)


def eat(order: dict[str, Any]) -> None:
    blocks = []
    while True:
        blocks.append(bytearray(os.urandom(1 << 20)) * 16)
        time.sleep(0.02)


def feed(order: dict[str, Any]) -> None:
    """Eat by a process of our own, as a trade-off does."""
    code = "import os, time; eaten = bytearray(os.urandom(1 << 20)) * 300; time.sleep(600)"
    child = subprocess.Popen([sys.executable, "-S", "-c", code])
    first_time(order)
    (Path(order["work"]) / "grandchild").write_text(str(child.pid))
    child.wait()


def meet(order: dict[str, Any]) -> None:
    """Wait until another one of us runs."""
    folder = Path(order["work"]).parent  # work itself goes when its job ends, perhaps before the other one looked
    (folder / f"{os.getpid()}.met").touch()
    while len(list(folder.glob("*.met"))) < 2:
        time.sleep(0.02)
    answer(order)


def print_much(order: dict[str, Any]) -> None:
    """Print as libraries do, and die of an error that nobody foresaw."""
    os.write(2, b'a warning with "quotes" and \xff\n')
    print("x" * 100_000, file=sys.stderr)
    raise RuntimeError("unforeseen")


def slowly(order: dict[str, Any]) -> None:
    """Take half a second."""
    time.sleep(0.5)
    answer(order)


def obey(order: dict[str, Any]) -> None:
    """Wait for a word, then answer."""
    work = Path(order["work"])
    (work / "waiting").mkdir(parents=True)
    while not (work / "go on").exists():
        time.sleep(0.02)
    answer(order)
    (work / "waiting").rmdir()


def lack_room(order: dict[str, Any]) -> None:
    """Find the disk full."""
    say(
        event="fault",
        fault={"kind": "no-space", "argument": "lift", "expected": "", "got": "a full disk", "hint": ""},
    )


def lack_room_once(order: dict[str, Any]) -> None:
    lack_room(order) if first_time(order) else answer(order)


BEHAVIOURS: dict[str, Callable[[dict[str, Any]], None]] = {
    function.__name__: function
    for function in (
        answer,
        die,
        die_once,
        eat,
        feed,
        hang,
        lack_room,
        lack_room_once,
        meet,
        obey,
        print_much,
        slowly,
        stop_once,
    )
}


def end_with_parent() -> None:
    sys.stdin.buffer.raw.read()  # pyright: ignore[reportAttributeAccessIssue]
    os._exit(3)


if __name__ == "__main__":
    threading.Thread(target=end_with_parent, daemon=True).start()
    BEHAVIOURS[sys.argv[1]](json.loads(Path(sys.argv[2]).read_bytes()))
