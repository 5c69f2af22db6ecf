"""The command line in this process: what it says to people and to programs, and how it refuses."""

from __future__ import annotations

import contextlib
import io
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from liftcore import cli

PROGRESS = re.compile(r"^\w+: \d+ of \d+ \w+\n", re.MULTILINE)  # what a slow machine tells every ten seconds


@dataclass(frozen=True)
class Reply:
    """The end of a command."""

    status: int
    out: str
    err: str  # without lines of progress

    @property
    def document(self) -> dict[str, Any]:
        """The one JSON document of stdout, of a command that succeeded."""
        assert self.status == 0, self.err
        assert self.out.count("\n") == 1 and self.out.endswith("\n")
        return json.loads(self.out, parse_constant=_refuse_constant)


def _refuse_constant(name: str) -> NoReturn:
    raise AssertionError(f"{name} is no JSON")


def run(*words: object) -> Reply:
    """Run `splatlift WORDS` in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = cli.main([*map(str, words)])
    return Reply(status, out.getvalue(), PROGRESS.sub("", err.getvalue()))


def error_line(*words: object) -> str:
    """Run a command that must end with status 2 and one line on stderr, and return the line."""
    reply = run(*words)
    assert (reply.status, reply.out) == (2, ""), reply
    assert reply.err.count("\n") == 1 and reply.err.startswith("splatlift"), reply.err
    return reply.err


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
