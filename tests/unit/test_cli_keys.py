"""``splatlift keys``: every option reaches the service's own program as it was given."""

from __future__ import annotations

import pytest

from liftcore import cli

from .command_line import programs_become, run


@pytest.mark.parametrize(
    "arguments",
    [
        ["create", "--name=-a b", "--scopes", "read,write", "--max-bytes", "0", "--max-uploads", "3", "--json"],
        ["create", "--name", "a", "--scopes", "admin", "--max-queued", "2", "--data", "a b"],
        ["list", "--data=-d"],
        ["revoke", "--json", "--", "-0123"],
    ],
)
def test_keys_becomes_the_program_of_the_service(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = programs_become(monkeypatch)
    assert run(capsys, "keys", *arguments)[0] == cli.INTERRUPTED
    (call,) = calls
    assert call[:2] == ["-m", "service.keys"]
    parse = cli.build_parser().parse_args
    assert vars(parse(["keys", *call[2:]])) == vars(parse(["keys", *arguments]))
