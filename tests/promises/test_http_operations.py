"""Running the service: health, documents, hosts and origins, the log, backups, and starts that are refused."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.server import PATIENCE_SECONDS, ROOT, Server, run_command, until
from tests.tiny_scene import TinyScene

from .over_http import assert_problem, delete_lift, operations_of, upload_scene


def test_service_is_alive_ready_and_of_a_version(client: httpx.Client, lift: dict[str, Any]) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    until(lambda: client.get("/readyz").status_code == 200)
    assert client.get("/openapi.json").json()["info"]["version"] == lift["version"]


def test_health_check_of_the_image_tells_a_live_server_from_a_dead_one(client: httpx.Client) -> None:
    dockerfile = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
    check = re.search(r"^HEALTHCHECK .*?CMD (\[.*?\])", dockerfile, re.MULTILINE | re.DOTALL)
    assert check is not None
    program, *command = json.loads(check[1])
    assert program == "python"
    with closing(socket.socket()) as silent_socket:  # bound, and not listening
        silent_socket.bind(("127.0.0.1", 0))
        for port, is_alive in ((client.base_url.port, True), (silent_socket.getsockname()[1], False)):
            environment = os.environ | {"SPLATLIFT_PORT": str(port)}
            ending = subprocess.run([sys.executable, *command], env=environment, capture_output=True, check=False)
            assert (ending.returncode == 0) is is_alive


def test_metrics_count_jobs_and_requests(client: httpx.Client, lift: dict[str, Any]) -> None:
    del lift
    reply = client.get("/metrics")
    assert reply.headers["content-type"].startswith("text/plain")
    lines = dict(line.rsplit(" ", 1) for line in reply.text.splitlines() if not line.startswith("#"))
    assert float(lines['splatlift_jobs{state="succeeded"}']) >= 1
    requests = {name for name in lines if name.startswith("splatlift_http_requests")}
    assert requests and not any(re.search("[0-9a-f]{32}", name) for name in requests)  # routes and not addresses


def test_openapi_document_describes_every_operation(client: httpx.Client) -> None:
    document = client.get("/openapi.json").json()
    names = []
    for method, path, description in operations_of(client):
        names.append(description["operationId"])
        assert " " in description["summary"], f"{method} {path}"
        assert set(description["responses"]) & {"200", "201", "202", "204"}, f"{method} {path}"
    assert len(set(names)) == len(names) and all(re.fullmatch("[a-z]+(_[a-z]+)*", name) for name in names)
    titles = [schema["title"] for schema in document["components"]["schemas"].values()]
    assert len(titles) == len(set(titles))  # a generated client gets one class for each name
    for reference in set(re.findall(r'"\$ref": ?"#/([^"]+)"', json.dumps(document))):
        node = document
        for part in reference.split("/"):
            node = node[part]
    for path in ("/assets/{asset}", "/lift", "/lift/plan", "/tradeoff", "/jobs/{job}/events", "/query", "/render"):
        assert path in document["paths"] or path.replace("{asset}", "{kind}") in document["paths"]


def test_page_and_documents_load_nothing_of_other_hosts(client: httpx.Client) -> None:
    for path in ("/", "/docs"):
        page = client.get(path)
        assert page.status_code == 200 and page.headers["content-type"].startswith("text/html")
        for address in re.findall(r"""<(?:script|link|img)[^>]*?(?:src|href)=['"]([^'"]+)""", page.text):
            if not address.startswith("data:"):
                assert client.get(f"/{address.lstrip('/')}").status_code == 200, address
    assert "splatlift" in client.get("/").text


def test_page_serves_the_libraries_that_it_names_compressed(client: httpx.Client, lift: dict[str, Any]) -> None:
    page = client.get("/").text
    libraries = json.loads(page.partition('<script type="importmap">')[2].partition("</script>")[0])
    assert set(libraries["imports"].values()) <= set(libraries["integrity"])
    preloaded = dict(re.findall('rel="modulepreload" href="([^"]+)" integrity="([^"]+)"', page))
    assert (
        preloaded.items()
        <= {name.removeprefix("./"): value for name, value in libraries["integrity"].items()}.items()
    )
    for address, digest in libraries["integrity"].items():
        library = client.get(address.removeprefix("."))
        assert library.headers["content-encoding"] == "gzip" and "immutable" in library.headers["cache-control"]
        assert base64.b64encode(hashlib.sha256(library.content).digest()).decode() == digest.removeprefix("sha256-")
        plain = client.get(address.removeprefix("."), headers={"Accept-Encoding": "identity"})
        assert plain.content == library.content and "content-encoding" not in plain.headers
        assert plain.headers["vary"] == library.headers["vary"] == "Accept-Encoding"
    script = "/web/src/main.js"
    for address in ("/", script, "/web/src/page.css"):
        reply = client.get(address)
        assert reply.headers["content-encoding"] == "gzip" and "immutable" not in reply.headers["cache-control"]
        assert client.post(address).headers["allow"] == "GET"
    assert 'route="/web/{path:path}"' in client.get("/metrics").text
    splats = f"/lifts/{lift['id']}/splats"
    stored, packed = (client.get(splats, headers={"Accept-Encoding": name}) for name in ("gzip", "zstd"))
    assert "content-encoding" not in stored.headers and packed.headers["content-encoding"] == "zstd"
    assert packed.content == stored.content and packed.headers["etag"] != stored.headers["etag"]
    part = client.get(script, headers={"Range": "bytes=0-31"})
    assert part.status_code == 206 and "content-encoding" not in part.headers
    assert part.content == client.get(script).content[:32]


def test_hosts_of_the_machine_are_taken_and_others_misdirected(client: httpx.Client) -> None:
    for host in ("localhost", "LOCALHOST:80", "127.0.0.1:9", "[::1]"):
        assert client.get("/lifts", headers={"Host": host}).status_code == 200, host
    for host in ("localhost.example.org:80", ""):
        for path in ("/healthz", "/lifts", "/"):
            assert_problem(client.get(path, headers={"Host": host}), 421)


def test_only_more_parameters_than_a_picture_has_are_too_many(client: httpx.Client, lift: dict[str, Any]) -> None:
    for count, status in ((1000, 200), (2000, 414)):
        parameters = {"lift": lift["id"], "view": lift["views"][0], "hide": ["object:0"] * count}
        reply = client.get("/render", params=parameters)
        assert reply.status_code == status, reply.text[:200]
    assert_problem(reply, 414)


@pytest.mark.parametrize("origin", ["http://127.0.0.1.example.org", "null", "http://localhost:1"])
def test_page_of_another_site_changes_nothing(
    client: httpx.Client, order: dict[str, Any], tiny: TinyScene, origin: str
) -> None:
    before = client.get("/jobs").json()
    headers = {"Origin": origin}
    for reply in (
        client.post("/lift", json=order, headers=headers),
        client.put("/assets/splats", content=tiny.splats, headers=headers),
        client.delete(f"/assets/{order['splats']}", headers=headers),
    ):
        assert_problem(reply, 403)
    assert client.get("/jobs").json() == before
    assert "access-control-allow-origin" not in client.get("/lifts", headers=headers).headers
    own_items = {"Origin": str(client.base_url).rstrip("/")}
    assert client.put("/assets/splats", content=tiny.splats, headers=own_items).status_code == 200


def test_answers_carry_safe_headers_and_request_ids(client: httpx.Client) -> None:
    for path in ("/healthz", "/lifts", "/nowhere", "/", "/openapi.json"):
        headers = client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff" and headers["x-request-id"], path
        assert headers["x-frame-options"] == "DENY" or "frame-ancestors" in headers["content-security-policy"]
    ids = {client.get("/nowhere").headers["x-request-id"] for _ in range(3)}
    assert len(ids) == 3
    reply = client.get("/nowhere", headers={"X-Request-ID": "mine-7"})
    assert reply.headers["x-request-id"] == "mine-7" == reply.json()["request_id"]
    for odd in ("a b", "x" * 1000, "<script>"):
        assert client.get("/nowhere", headers={"X-Request-ID": odd}).headers["x-request-id"] != odd


def test_job_and_log_have_the_request_id_and_no_secret(client: httpx.Client, server: Server, tiny: TinyScene) -> None:
    headers = {"X-Request-ID": "the-order", "Authorization": "Bearer the-secret", "Cookie": "the-secret"}
    order = upload_scene(client, tiny)
    job = client.post("/lift", json=order, headers=headers).json()
    assert job["request_id"] == "the-order"
    client.post(f"{job['links']['self']}/cancel")
    for path in ("/healthz?token=the-secret", "/nowhere?the-secret", "/query?text=the-secret"):
        client.get(path, headers=headers)
    client.put("/assets/splats", content=b"the-secret", headers=headers)
    text = until(lambda: server.log.read_text() if server.log.read_text().count("the-order") >= 5 else "")
    assert "the-secret" not in text
    lines = [json.loads(line) for line in text.splitlines()]
    statuses = [line.get("status") for line in lines if line.get("request_id") == "the-order" and "status" in line]
    assert statuses.count(200) == 1 and {202, 404, 422} <= set(statuses)
    until(lambda: client.get(job["links"]["self"]).json()["state"] in ("canceled", "succeeded"))
    client.delete(job["links"]["self"])
    client.delete(job["links"]["self"], params={"with_lift": True})


def test_slow_clients_keep_nobody_waiting(client: httpx.Client) -> None:
    with ExitStack() as stack:
        for number in range(60):
            address = (client.base_url.host, client.base_url.port or 80)
            connection = stack.enter_context(closing(socket.create_connection(address)))
            head = b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000\r\n\r\nply"
            connection.sendall(head if number % 2 else b"GET /healthz HTTP/1.1\r\nHo")
        for path in ("/healthz", "/readyz", "/lifts"):
            assert client.get(path).status_code == 200, path
        upload_reply = client.put("/assets/cameras", content=b"{}")
        assert_problem(upload_reply, 422)


# Data


def test_backup_is_served_as_it_was_and_its_damage_is_found(
    server: Server, lift: dict[str, Any], order: dict[str, Any], tiny: TinyScene, encoder: str, tmp_path: Path
) -> None:
    client, backup = server.client, tmp_path / "backup"
    run_command("store", "backup", str(backup), data=server.data)
    run_command("store", "backup", str(backup), data=server.data, status=2)  # it replaces nothing
    run_command("store", "verify", data=backup)
    floor = 10 * shutil.disk_usage(backup).total
    with Server(backup, encoder=encoder, disk_floor_bytes=floor) as full:
        paths = (lift["links"]["self"], f"/query?lift={lift['id']}&text=lamp", "/healthz", "/assets")
        for path in paths:
            assert full.client.get(path).json() == client.get(path).json()
        assert full.client.get(f"/assets/{order['splats']}/content").content == tiny.splats
        jobs = full.client.get("/jobs").json()
        for reply in (
            full.client.put("/assets/splats", content=tiny.splats + b"\n"),
            full.client.post("/lift", json=order),
        ):
            assert_problem(reply, 507)  # a full disk takes nothing more
        assert full.client.get("/jobs").json() == jobs
        delete_lift(full.client, lift["id"])  # which makes room
    assert client.get(lift["links"]["features"]).status_code == 200
    digest = order["splats"].removeprefix("sha256:")
    (file,) = (path for path in backup.rglob("*") if digest in path.name)
    content = file.read_bytes()
    for damage in (content[:-1], content[:-1] + b"\1", None):
        file.unlink()  # and not the server's file, which it may be a link to
        if damage is not None:
            file.write_bytes(damage)
        assert digest[:8] in run_command("store", "verify", data=backup, status=1)
        assert file.exists() is (damage is not None)  # it changes nothing
        file.touch()
    for path in backup.glob("*.sqlite*"):
        path.unlink()
    line = run_command("serve", "--port", "0", data=backup, status=2)
    assert line.count("\n") == 1 and "service.sqlite" in line and file.exists()


def test_second_server_of_a_directory_is_refused(server: Server, tmp_path: Path) -> None:
    assert str(server.data) in run_command("serve", "--port", "0", data=server.data, status=2)
    port = str(server.client.base_url.port)
    assert port in run_command("serve", "--port", port, data=tmp_path / "other", status=2)
    assert server.client.get("/healthz").status_code == 200


@pytest.mark.parametrize(
    "options",
    [
        ["--host", "0.0.0.0"],  # beyond this machine only with keys
        ["--encoder", "table:/nowhere/table.safetensors"],
    ],
    ids=" ".join,
)
def test_setting_that_cannot_be_is_refused_at_the_start(options: list[str], tmp_path: Path) -> None:
    line = run_command("serve", "--port", "0", *options, data=tmp_path / "data", status=2)
    assert "splatlift" in line and "Traceback" not in line
    assert not (tmp_path / "data").exists()


def test_data_directory_is_for_its_user_alone(server: Server) -> None:
    assert server.data.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    "head",
    [
        "POST /query HTTP/1.1\r\nContent-Length: 5\r\nTransfer-Encoding: chunked",
        "POST /query HTTP/1.1\r\nContent-Length: 5\r\nTransfer-Encoding:\tchunked",
        "CONNECT localhost:80 HTTP/1.1\r\nAccept: */*",
    ],
)
def test_what_hides_behind_an_unclear_end_is_not_answered(client: httpx.Client, head: str) -> None:
    answer = b""
    with socket.create_connection((client.base_url.host, client.base_url.port or 80), PATIENCE_SECONDS) as connection:
        hidden = "0\r\n\r\nGET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
        connection.sendall(f"{head}\r\nHost: localhost\r\n\r\n{hidden}".encode())
        with suppress(ConnectionResetError):  # the server does not read the rest
            while content := connection.recv(1 << 16):
                answer += content
    assert answer.startswith(b"HTTP/1.1 400 ") and answer.count(b"HTTP/1.1 ") == 1


def test_refusal_that_nobody_awaits_is_no_error(client: httpx.Client, server: Server) -> None:
    before = len(server.log.read_text())
    with socket.create_connection((client.base_url.host, client.base_url.port or 80), PATIENCE_SECONDS) as connection:
        head = "POST /query HTTP/1.1\r\nHost: elsewhere\r\nTransfer-Encoding: chunked\r\n\r\n"
        connection.sendall(f"{head}no chunk\r\n".encode())
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 4")
    assert client.get("/healthz").status_code == 200
    assert '"level": "error"' not in server.log.read_text()[before:]
