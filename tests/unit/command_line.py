"""The command line in this process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore import cli

if TYPE_CHECKING:
    import pytest


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """The exit status, and what went to stdout and stderr."""
    status = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def assert_one_line(err: str) -> None:
    """What went to stderr is one line, and ends."""
    assert err.endswith("\n")
    assert err.count("\n") == 1
