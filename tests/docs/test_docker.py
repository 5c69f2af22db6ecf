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


def health_check() -> list[str]:
    command = re.search(r"^HEALTHCHECK .*?CMD (\[.*?\])", text("docker/Dockerfile"), re.MULTILINE | re.DOTALL)
    assert command is not None
    return json.loads(command[1])


def test_health_check_tells_a_live_server_from_a_dead_one(tmp_path: Path) -> None:
    program, *command = health_check()
    assert program == "python"
    with Server(tmp_path / "data") as service:
        port = os.environ | {"SPLATLIFT_PORT": str(service.client.base_url.port)}
        command_line = [sys.executable, *command]
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode == 0
        service.kill()
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode != 0
