"""Refusals before a body is read: Host, Origin, key and size are judged by the head alone. And the log.

python -m tests.gate.g16_doors
"""

from __future__ import annotations

import argparse
import json
import socket
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import small_scene

PROMISED_BYTES = 1 << 30  # a body that never comes
SECONDS = 20  # in which a head must be answered
FOREIGN_HOSTS = ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "localhost@evil.example", "")
FOREIGN_ORIGINS = ("https://evil.example", "null", "http://localhost.evil.example", "http://127.0.0.1@evil.example")
TOO_LARGE = 1 << 50


def gate(_: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Send heads without a key, then with keys."""
    with Service(folder / "data") as service:
        body = service.upload(small_scene())
        service.wait_for(service.order(body))
        heads = ("PUT /assets/splats", "POST /lift", "POST /lift/plan", "POST /tradeoff", "POST /query")
        hosts = {(head, host): status_of(service, head, Host=host) for head in heads for host in FOREIGN_HOSTS}
        reads = {host: status_of(service, "GET /lifts", 0, Host=host) for host in FOREIGN_HOSTS}
        wrong = [row for row in [*hosts.items(), *reads.items()] if row[1] not in (400, 421)]
        verdicts.check("a foreign Host is refused before the body", not wrong, wrong[:3] or f"{len(hosts)} heads")
        origins = {
            (head, origin): status_of(service, head, Origin=origin) for head in heads for origin in FOREIGN_ORIGINS
        }
        wrong = [row for row in origins.items() if row[1] != 403]
        verdicts.check("a foreign Origin is refused before the body", not wrong, wrong[:3] or f"{len(origins)} heads")
        sizes = {head: status_of(service, head, TOO_LARGE) for head in heads}
        verdicts.check("too large a body is 413 before it comes", set(sizes.values()) == {413}, sizes)
        crowded = status_of(service, f"GET /query?{'&'.join(['text=a'] * 6000)}", 0)
        verdicts.check("6,000 parameters are 414", crowded == 414, crowded)
        before = service.get("/assets").json()

        reader = service.run(
            "keys", "create", "--name", "r", "--scopes", "read", "--data", str(service.data), "--json"
        )
        secret = json.loads(reader.stdout)["key"]
        absent = {head: status_of(service, head) for head in heads}
        verdicts.check("without a key: 401 before the body", set(absent.values()) == {401}, absent)
        writes = {head: status_of(service, head, Authorization=f"Bearer {secret}") for head in heads[:4]}
        verdicts.check("without the scope: 403 before the body", set(writes.values()) == {403}, writes)
        admin = service.run(
            "keys", "create", "--name", "a", "--scopes", "admin", "--data", str(service.data), "--json"
        )
        headers = {"Authorization": f"Bearer {json.loads(admin.stdout)['key']}"}
        verdicts.check("none of these left anything", service.get("/assets", headers=headers).json() == before)

        reply = service.get("/nowhere", headers=headers)
        number = reply.headers.get("x-request-id", "-")
        lines = [json.loads(line) for line in service.log.read_text().splitlines() if line.startswith("{")]
        is_logged = sum(line.get("request_id") == number for line in lines) == 1
        verdicts.check("an answer's X-Request-ID is in the log, once", is_logged, number)
        log = service.log.read_text()
        verdicts.check("no key and no query string is in the log", secret not in log and "?" not in log)
        verdicts.check("nothing lies in the scratch folders", not service.scratch(), service.scratch())


def status_of(service: Service, head: str, length: int = PROMISED_BYTES, **headers: str) -> int:
    """Send a head that promises a body, and nothing more; the status, or 0 where no answer comes."""
    fields = {"Host": "localhost", "Content-Type": "application/json", "Content-Length": str(length)} | headers
    lines = [f"{head} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items()), "", ""]
    with socket.create_connection(("127.0.0.1", service.base_url.port or 80), SECONDS) as connection:
        try:
            connection.sendall("\r\n".join(lines).encode())
            return int(connection.recv(100).split()[1])
        except (OSError, IndexError):
            return 0


if __name__ == "__main__":
    run_gate(gate, __doc__)
