"""The service against its own OpenAPI document: schemathesis calls every operation over real sockets.

The server is `splatlift serve` with a lift of the tiny scene.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.promises.over_http import lift_of, upload_scene
from tests.server import Server, run_command, until
from tests.tiny_scene import make_scene

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "response_headers_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method",
    "allow_header_conformance", "use_after_free", "ensure_resource_availability", "ignored_auth",
)  # fmt: skip
# What breaks the schema by its length may break the limit of a body first.
REFUSALS = """[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 406, 409, 412, 413, 414, 415, 422, 428, 429]
"""
# A longer head is answered by uvicorn (docs/service.md).
HOOKS = """import schemathesis
from urllib.parse import urlencode
@schemathesis.hook
def filter_query(context, query):
    return len(urlencode(query or {}, doseq=True, errors="replace")) < 60_000
"""
SECONDS = 1500.0  # that schemathesis may take; a busy machine needs more


def failures_of(folder: Path, *, examples: int, phases: Sequence[str]) -> str:
    """Return the failures that schemathesis reports; empty if there are none. The same seed makes the same calls.

    Args:
        folder: for the data of the server.
        examples: of each operation and phase.
        phases: of schemathesis.
    """
    scene, table = make_scene(), folder / "table.safetensors"
    table.write_bytes(scene.table)
    with Server(folder / "data", encoder=f"table:{table}") as server:
        options = ("--name", "contract", "--scopes", "read,write", "--json")
        secret = json.loads(run_command("keys", "create", *options, data=server.data))["key"]
        server.client.headers["Authorization"] = f"Bearer {secret}"
        lift_of(server.client, upload_scene(server.client, scene))
        until(lambda: server.client.get("/query", params={"text": "apple"}).status_code == 200)
        command = [
            str(Path(sys.executable).with_name("schemathesis")), "run",
            str(server.client.base_url.join("/openapi.json")),
            "--no-color", "--checks", ",".join(CHECKS), "--phases", ",".join(phases), "--max-examples", str(examples),
            "--seed", "1", "--generation-deterministic", "--continue-on-failure", "--no-shrink",
            "--suppress-health-check", "all", "--warnings", "off", "--request-timeout", "300",
            "--header", f"Authorization: Bearer {secret}",
        ]  # fmt: skip
        (folder / "schemathesis.toml").write_text(REFUSALS)
        (folder / "hooks.py").write_text(HOOKS)
        hooked = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(folder)}
        process = subprocess.run(
            command, cwd=folder, env=hooked, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    return "" if process.returncode == 0 else f"{process.stdout}\n{process.stderr}"
