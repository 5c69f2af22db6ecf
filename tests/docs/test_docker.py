"""The image, the compose file and the proxy name files, settings, ports and limits as the service has them.

No image is built here: there is no engine.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from service.models import BITS_BYTES
from service.settings import ServiceSettings
from tests.server import Server

from .readme import text

DEFAULTS = ServiceSettings.model_construct()


def instructions() -> list[tuple[str, str]]:
    """The instructions of the Dockerfile: name and arguments, continued lines joined."""
    lines = [line for line in text("docker/Dockerfile").splitlines() if not line.startswith("#")]
    joined_lines = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in joined_lines.splitlines() if line.strip()]


def arguments_of(name: str) -> list[str]:
    return [arguments for instruction, arguments in instructions() if instruction == name]


def services() -> dict[str, Any]:
    """Those that are this service: the proxy is built by others."""
    instruction = yaml.safe_load(text("docker/compose.yaml"))["services"]
    assert instruction.pop("proxy")["volumes"][0] == "./Caddyfile:/etc/caddy/Caddyfile:ro"
    return instruction


def test_the_proxy_has_the_limits_of_the_service() -> None:
    caddy = text("docker/Caddyfile")
    mib = BITS_BYTES >> 20
    assert f"max_size {DEFAULTS.upload_bytes >> 30}GiB # SPLATLIFT_UPLOAD_BYTES" in caddy
    assert all(f"\t{limit} " in caddy for limit in ("read_header 10s", "read_body 30m", "write 30m"))
    assert f"request_buffers {mib}MiB" in caddy  # a body of JSON that is slow to come waits there
    assert f"splatlift:{DEFAULTS.port}" in caddy and "Host localhost" in caddy
    assert "health_uri /healthz" in caddy  # what must come through on a full disk does


def health_check() -> list[str]:
    (check,) = arguments_of("HEALTHCHECK")
    return json.loads(check.partition(" CMD ")[2])


def test_the_port_is_the_services_own_everywhere() -> None:
    assert arguments_of("EXPOSE") == [str(DEFAULTS.port)]
    assert f"(os.environ.get('SPLATLIFT_PORT') or {DEFAULTS.port})" in " ".join(health_check())
    for service in services().values():
        assert service["ports"] == [f"127.0.0.1:{DEFAULTS.port}:{DEFAULTS.port}"]


def test_health_check_tells_a_live_server_from_a_dead_one(tmp_path: Path) -> None:
    program, *command = health_check()
    assert program == "python"
    with Server(tmp_path / "data") as service:
        port = os.environ | {"SPLATLIFT_PORT": str(service.client.base_url.port)}
        command_line = [sys.executable, *command]
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode == 0
        service.kill()
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode != 0
