"""The health check of the image tells a live server from a dead one; no image is built here."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from tests.server import Server

from .readme import text


def instructions() -> list[tuple[str, str]]:
    """The instructions of the Dockerfile: name and arguments, continued lines joined."""
    lines = [line for line in text("docker/Dockerfile").splitlines() if not line.startswith("#")]
    joined_lines = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in joined_lines.splitlines() if line.strip()]


def arguments_of(name: str) -> list[str]:
    return [arguments for instruction, arguments in instructions() if instruction == name]


def health_check() -> list[str]:
    (check,) = arguments_of("HEALTHCHECK")
    return json.loads(check.partition(" CMD ")[2])


def test_health_check_tells_a_live_server_from_a_dead_one(tmp_path: Path) -> None:
    program, *command = health_check()
    assert program == "python"
    with Server(tmp_path / "data") as service:
        port = os.environ | {"SPLATLIFT_PORT": str(service.client.base_url.port)}
        command_line = [sys.executable, *command]
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode == 0
        service.kill()
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode != 0
