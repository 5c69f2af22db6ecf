"""The command line in this process, and a scene that it lifts in no time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from liftcore import cli

if TYPE_CHECKING:
    import pytest

PROGRESS = re.compile(r"^\w+: \d+ of \d+ \w+\n", re.MULTILINE)  # what a slow machine tells every ten seconds


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """The exit status, and what went to stdout and stderr but for lines of progress."""
    status = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, PROGRESS.sub("", captured.err)


def assert_one_line(err: str) -> None:
    """Output on stderr is one line, and ends."""
    assert err.endswith("\n")
    assert err.count("\n") == 1
