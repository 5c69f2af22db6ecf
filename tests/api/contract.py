"""The service against its own OpenAPI document: schemathesis calls every operation over real sockets.

    python -m tests.api.contract [--examples N] [--phases PHASE ...] [--keys without|with]

What would take seconds a call has a stand-in: the check of an upload takes any bytes, and a lift is done at once. So
uploads and lifts succeed here, and what is made can be looked at, asked and deleted. Queries run in the real worker,
over a store that may hold a real lift.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import httpx

from service.app import create_app, job_limits, query_limits
from service.query_client import QueryClient
from service.sandbox import SandboxResult
from service.settings import ServiceSettings
from service.store.keys import Quota
from service.store.owners import Scope
from service.store.store import Store
from service.supervisor import Supervisor
from service.uploads import Report
from tests.crash.conftest import address_of, listening, stand_in, until

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "response_headers_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method",
    "allow_header_conformance", "use_after_free", "ensure_resource_availability", "ignored_auth",
)  # fmt: skip
PHASES = ("examples", "coverage", "fuzzing", "stateful")
# What breaks the schema by its length may break the limit of a body first.
REFUSALS = """[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 406, 409, 412, 413, 415, 422, 428, 429]
"""
# A longer head is answered by uvicorn (docs/service.md).
HOOKS = """import schemathesis
from urllib.parse import urlencode
@schemathesis.hook
def filter_query(context, query):
    return len(urlencode(query or {}, doseq=True, errors="replace")) < 60_000
"""
SECONDS = 1500.0  # that schemathesis may take; a busy machine needs more
PATIENCE_SECONDS = 300.0  # for what takes some seconds; the machine may be busy


@contextmanager
def serve(data: Path, *, keys: bool, **settings: Any) -> Iterator[tuple[str, str | None]]:
    """A server in a thread over a data directory: its address, and a key that may do everything."""
    server_settings = ServiceSettings.model_validate({"data": data, **settings})
    store = Store.open(server_settings.data)
    secret = store.keys.create("contract", frozenset({Scope.ADMIN}), Quota())[1] if keys else None
    runner = Supervisor(store, job_limits(server_settings), command=stand_in("answer"))
    app = create_app(server_settings, store, runner, QueryClient(query_limits(server_settings)))
    empty_asset = {"sha256": "0" * 64}
    metadata = {"splats": empty_asset, "cameras": empty_asset, "features": [], "settings": {}, "views": ["v"]}
    lift = {"metadata": metadata, "count": 1}
    report = Report(".bin", {"names": ["v"], "channels": 1, "classes": 1, "words": ["apple"], **lift}, [])
    planned = SandboxResult({"event": "valid", "plan": {"summary": [], "warnings": []}}, 0, "")
    with (
        mock.patch("service.uploads.check", lambda *arguments: report),
        mock.patch("service.routes.jobs.run_sandboxed", lambda *arguments: planned),
    ):
        try:
            with listening(app, server_settings) as server:
                address = "http://{}:{}".format(*address_of(server))
                _warm_up(address, secret)
                yield address, secret
        finally:
            store.close()


def _warm_up(address: str, secret: str | None) -> None:
    """Wait until the query worker has loaded what it needs: a 503 until then is no fault. The document takes a
    second of an idle machine once, and schemathesis waits 10 s for it.
    """
    key = {} if secret is None else {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=address, headers=key, timeout=PATIENCE_SECONDS) as client:
        until(lambda: client.get("/readyz").status_code == 200, PATIENCE_SECONDS)
        until(lambda: client.get("/query", params={"text": "apple"}).status_code < 500, PATIENCE_SECONDS)
        client.get("/openapi.json").raise_for_status()


def conformance(
    address: str,
    secret: str | None,
    *,
    examples: int,
    phases: Sequence[str] = PHASES,
    without: str | None = None,
    seconds: float = SECONDS,
) -> str:
    """Return the failures that schemathesis reports; empty if there are none. The same seed makes the same calls.

    Args:
        address: of the server.
        secret: a key.
        examples: of each operation and phase.
        phases: of schemathesis; those of `coverage` are as many as the schema has corners.
        without: a pattern of paths that are left out.
        seconds: that it may take.
    """
    command = [
        str(Path(sys.executable).with_name("schemathesis")), "run", f"{address}/openapi.json", "--no-color",
        "--checks", ",".join(CHECKS), "--phases", ",".join(phases), "--max-examples", str(examples),
        "--seed", "1", "--generation-deterministic", "--continue-on-failure",
        "--no-shrink", "--suppress-health-check", "all", "--warnings", "off", "--request-timeout", "300",
    ]  # fmt: skip
    command += [] if without is None else ["--exclude-path-regex", without]
    command += [] if secret is None else ["--header", f"Authorization: Bearer {secret}"]
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "schemathesis.toml").write_text(REFUSALS)
        Path(folder, "hooks.py").write_text(HOOKS)
        hooked = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": folder}
        process = subprocess.run(
            command, cwd=folder, env=hooked, capture_output=True, text=True, timeout=seconds, check=False
        )
    return "" if process.returncode == 0 else f"{process.stdout}\n{process.stderr}"


def main() -> int:
    """The long form, without keys and with them; 1 when something does not conform."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=30, help="of each operation and phase")
    parser.add_argument("--phases", nargs="+", choices=PHASES, default=PHASES, help="of schemathesis")
    parser.add_argument("--keys", nargs="+", choices=("without", "with"), default=("without", "with"))
    parser.add_argument("--seconds", type=float, default=SECONDS, help="that either may take")
    options = parser.parse_args()
    wrong = False
    for keys in options.keys:
        with (
            tempfile.TemporaryDirectory() as folder,
            serve(Path(folder) / "data", keys=keys == "with") as (address, secret),
        ):
            start = time.monotonic()
            failures = conformance(
                address, secret, examples=options.examples, phases=options.phases, seconds=options.seconds
            )
        wrong = wrong or bool(failures)
        head = f"--- {keys} keys, {time.monotonic() - start:.0f} s ---"
        print(head, failures or "everything conforms", sep="\n", flush=True)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
