"""The image and the compose file say what is true of this service. No image is built here: there is no engine."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml

from liftcore import __version__
from service.settings import ServiceSettings
from tests.crash.service_process import ServiceProcess

from .readme import ROOT, text

DEFAULTS = ServiceSettings.model_construct()


def instructions() -> list[tuple[str, str]]:
    """The instructions of the Dockerfile: name and arguments, continued lines joined."""
    lines = [line for line in text("docker/Dockerfile").splitlines() if not line.startswith("#")]
    joined_lines = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in joined_lines.splitlines() if line.strip()]


def arguments_of(name: str) -> list[str]:
    return [arguments for instruction, arguments in instructions() if instruction == name]


def environment() -> dict[str, str]:
    return dict(re.findall(r"([A-Z_]+)=(\S*)", " ".join(arguments_of("ENV"))))


def services() -> dict[str, Any]:
    """Those that are this service: the proxy is built by others."""
    instruction = yaml.safe_load(text("docker/compose.yaml"))["services"]
    assert instruction.pop("proxy")["volumes"][0] == "./Caddyfile:/etc/caddy/Caddyfile:ro"
    return instruction


def test_the_proxy_has_the_limits_of_the_service() -> None:
    caddy = text("docker/Caddyfile")
    gib, mib = DEFAULTS.max_features_bytes >> 30, DEFAULTS.max_body_bytes >> 20
    assert f"max_size {gib}GiB # SPLATLIFT_MAX_FEATURES_BYTES" in caddy
    assert f"max_size {DEFAULTS.max_lift_bytes >> 30}GiB # SPLATLIFT_MAX_LIFT_BYTES" in caddy
    assert f"max_size {mib}MiB # SPLATLIFT_MAX_BODY_BYTES" in caddy
    assert all(f"\t{limit} " in caddy for limit in ("read_header 10s", "read_body 30m", "write 30m"))
    assert f"request_buffers {mib}MiB" in caddy  # a body of JSON that is slow to come waits there
    assert f"splatlift:{DEFAULTS.port}" in caddy and "Host localhost" in caddy
    uploads = re.findall(r"@(\w+) \{\s+method (.+)\s+path (.+)\s+\}\s+request_body @\1 ", caddy)
    limits = [("PUT POST", "/assets /assets/*"), ("POST", "/lifts")]
    assert [(methods, paths) for _, methods, paths in uploads] == limits
    assert re.findall(r"not \{\s+method (.+)\s+path (.+)", caddy) == limits
    assert "health_uri /healthz" in caddy  # what must come through on a full disk does


def test_the_service_believes_the_proxy_alone_about_clients() -> None:
    compose = yaml.safe_load(text("docker/compose.yaml"))
    address = compose["services"]["proxy"]["networks"]["default"]["ipv4_address"]
    assert {service["environment"]["SPLATLIFT_FORWARDED_ALLOW"] for service in services().values()} == {address}
    (network,) = compose["networks"]["default"]["ipam"]["config"]
    default = ipaddress.ip_address(address.rpartition(":-")[2].rstrip("}"))
    assert default in ipaddress.ip_network(network["subnet"].rpartition(":-")[2].rstrip("}"))


def health_check() -> list[str]:
    (check,) = arguments_of("HEALTHCHECK")
    return json.loads(check.partition(" CMD ")[2])


def test_everything_that_is_copied_is_here_and_in_the_build_context() -> None:
    exceptions = [line[1:] for line in text(".dockerignore").splitlines() if line.startswith("!")]
    copied = [words.split() for words in arguments_of("COPY") if "--from=" not in words]
    assert copied
    for source in (source for words in copied for source in words[:-1]):
        assert (ROOT / source).exists(), source
        assert any(fnmatch(source, name) for name in exceptions), source
    assert {source for words in copied for source in words[:-1]} == set(exceptions)


FILES = ("docker/Dockerfile", "docker/compose.yaml", "docker/compose.ray.yaml")


def test_every_variable_is_a_setting() -> None:
    variables = set(re.findall(r"SPLATLIFT_[A-Z_]+", "".join(map(text, FILES))))
    assert variables
    assert {name.removeprefix("SPLATLIFT_").lower() for name in variables} <= ServiceSettings.model_fields.keys()


def test_the_port_is_the_services_own_everywhere() -> None:
    assert arguments_of("EXPOSE") == [str(DEFAULTS.port)]
    assert f"(os.environ.get('SPLATLIFT_PORT') or {DEFAULTS.port})" in " ".join(health_check())
    for service in services().values():
        assert service["ports"] == [f"127.0.0.1:{DEFAULTS.port}:{DEFAULTS.port}"]


def test_versions_come_from_the_lock_and_torch_is_first() -> None:
    installs = [run for run in arguments_of("RUN") if "pip install" in run]
    assert "^(torch(vision)?==" in installs[0] and "requirements.lock" in installs[0]
    hashed = next(k for k, run in enumerate(installs) if "--require-hashes --requirement runtime.lock" in run)
    assert hashed > 0 and all("--no-deps" in run for run in installs[:hashed])  # else torch's needs come without
    assert all("lock" in run or "--constraint pins.txt" in run or "--no-deps ." in run for run in installs)
    assert not any("--constraint requirements.lock" in run for run in installs)  # its digests would be asked of all
    locked = {line.split("==")[0].lower().replace("_", "-") for line in text("requirements.lock").splitlines()}
    assert all("--hash=sha256:" in block for block in re.split(r"\n(?=[a-z])", text("requirements.lock"))[1:])
    dependencies = re.search(r"^dependencies = \[(.*?)^\]", text("pyproject.toml"), flags=re.MULTILINE | re.DOTALL)
    assert dependencies is not None
    names = {name.lower().replace("_", "-") for name in re.findall(r'"([A-Za-z0-9_.-]+)', dependencies[1])}
    assert names <= locked


def test_one_version_is_the_same_everywhere() -> None:
    assert f'\nversion = "{__version__}"\n' in text("pyproject.toml")
    versions = re.findall(r"^## ([\d.]+)(.*)$", text("CHANGELOG.md"), re.MULTILINE)
    assert next(version for version, note in versions if "not released" not in note) == __version__
    assert set(re.findall(r"splatlift:([\d.]+)", text("docker/Dockerfile"))) == {__version__}


def test_the_service_is_no_root_and_gets_its_signals() -> None:
    names = [name for name, _ in instructions()]
    assert names.index("USER") < names.index("CMD") and arguments_of("USER") != ["root"]
    assert json.loads(arguments_of("ENTRYPOINT")[0])[0].endswith("tini")
    assert json.loads(arguments_of("CMD")[0]) == ["python", "-m", "service"]  # exec form: no shell between
    for service in services().values():
        assert float(service["stop_grace_period"].rstrip("s")) > DEFAULTS.notice_seconds + DEFAULTS.stop_seconds
        assert service["read_only"] and service["cap_drop"] == ["ALL"] and service["mem_limit"]


def test_what_is_written_lies_in_the_volume() -> None:
    assert arguments_of("VOLUME") == ["/data"]
    for name in ("SPLATLIFT_DATA", "XDG_CACHE_HOME"):
        assert Path(environment()[name]).is_relative_to("/data")
    assert all("data:/data" in service["volumes"] for service in services().values())


def test_health_check_tells_a_live_server_from_a_dead_one(tmp_path: Path) -> None:
    program, *command = health_check()
    assert program == "python"
    with ServiceProcess(tmp_path, "--behaviour", "answer") as service:
        port = os.environ | {"SPLATLIFT_PORT": str(service.client.base_url.port)}
        command_line = [sys.executable, *command]
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode == 0
        service.kill()
        assert subprocess.run(command_line, env=port, capture_output=True, timeout=60, check=False).returncode != 0
