"""The service does what its OpenAPI document says, with keys: schemathesis calls each operation over real sockets."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.slow
def test_answers_are_as_the_document_says_and_what_is_deleted_is_gone(tmp_path: Path) -> None:
    """With one example of each operation; the same seed makes the same calls."""
    scene, table = make_scene(), tmp_path / "table.safetensors"
    table.write_bytes(scene.table)
    with Server(tmp_path / "data", encoder=f"table:{table}") as server:
        options = ("--name", "contract", "--scopes", "read,write", "--json")
        secret = json.loads(run_command("keys", "create", *options, data=server.data))["key"]
        server.client.headers["Authorization"] = f"Bearer {secret}"
        lift_of(server.client, upload_scene(server.client, scene))
        until(lambda: server.client.get("/query", params={"text": "apple"}).status_code == 200)
        command = [
            str(Path(sys.executable).with_name("schemathesis")), "run",
            str(server.client.base_url.join("/openapi.json")),
            "--no-color", "--checks", ",".join(CHECKS), "--phases", "fuzzing,stateful", "--max-examples", "1",
            "--seed", "1", "--generation-deterministic", "--continue-on-failure", "--no-shrink",
            "--suppress-health-check", "all", "--warnings", "off", "--request-timeout", "300",
            "--header", f"Authorization: Bearer {secret}",
        ]  # fmt: skip
        (tmp_path / "schemathesis.toml").write_text(REFUSALS)
        (tmp_path / "hooks.py").write_text(HOOKS)
        hooked = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(tmp_path)}
        process = subprocess.run(
            command, cwd=tmp_path, env=hooked, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    assert process.returncode == 0, f"{process.stdout}\n{process.stderr}"
