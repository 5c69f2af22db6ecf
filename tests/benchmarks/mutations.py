"""Uploads, requests and keys that are changed at random, and jobs canceled at random moments: part of ``make soak``.

    python -m tests.benchmarks.mutations [--uploads N] [--requests N] [--keys N] [--cancels N] [--root DIR] [--seed N]

Each loop runs ``python -m service`` of a checkout (``--root``, with its own ``.venv``; else this one) and speaks HTTP
alone, so that releases can be compared. Figures are one JSON object on stdout; status 1 where a promise was broken.
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import httpx
import numpy as np

from tests import tiny_scene
from tests.api.test_photo_zips import photos_zip
from tests.benchmarks.base import machine
from tests.benchmarks.soak import scene_files
from tests.crash.service_process import FINAL_STATES, ROOT, processes_of

CLIENTS = 2  # that send at the same time
WAITING_SECONDS = 3.0  # for an answer to a head that may promise more than comes
CANCEL_SECONDS = 5.0  # that `canceled` may take
EXTREMES = (b"0", b"-1", b"1e999", b"NaN", b"4294967296", b"9" * 400, b"18446744073709551617")
ODD = (None, True, -1, 0, 10**400, 1e308, "", "\ud800", "\0", "a" * 5000, [], {}, [[]], [None], {"a": {}})
HEADERS = ("Range", "If-None-Match", "Content-Type", "Idempotency-Key", "Last-Event-ID", "Accept")
CHARACTERS = ("", "\0", "%", "\r\n", "a" * 3000, "../..", "\ud800", "9" * 400, "-1", "nan", "left:0,0", "\u2028")


@dataclass
class Server:
    """``python -m service`` of a checkout over a data directory."""

    root: Path
    data: Path
    options: tuple[str, ...] = ()
    url: str = ""

    @contextmanager
    def running(self) -> Iterator[Server]:
        """Start it; at the end, stop it in order, and fail where its status is not 0."""
        command = [self.python, "-m", "service", "--port", "0", "--data", str(self.data), *self.options]
        with self.log.open("wb") as log, subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=self.root
        ) as process:  # fmt: skip
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("listening on "), self.log.read_text()
            self.url = line.split()[-1]
            try:
                yield self
            finally:
                process.terminate()
                status = process.wait(60)
        assert status == 0, status

    @property
    def python(self) -> str:
        """The interpreter that has the checkout's packages."""
        interpreter = self.root / ".venv/bin/python"
        return str(interpreter) if interpreter.exists() else sys.executable

    @property
    def log(self) -> Path:
        """Return the text of its standard error."""
        return self.data.with_name(f"{self.data.name}.log")

    def client(self, **headers: str) -> httpx.Client:
        """A client of it."""
        return httpx.Client(base_url=self.url, timeout=600, headers=headers)

    def tracebacks(self) -> int:
        """Count the tracebacks in the log."""
        return self.log.read_text(errors="replace").count("Traceback (most recent call last)")

    def left_over(self) -> list[str]:
        """Drafts and scratch folders that are there."""
        return sorted(path.name for path in (self.data / "tmp").iterdir())


def mutate_bytes(content: bytes, chance: random.Random, donors: list[bytes]) -> bytes:
    """Bytes changed in one to three places: flipped, overwritten, cut, doubled, cut off, spliced, or a number in
    digits put in place of another."""
    output = bytearray(content)
    for _ in range(chance.randint(1, 3)):
        place = chance.randrange(len(output) // chance.choice((1, 8)) + 1)  # headers are at the beginning
        length = chance.choice((1, 4, 8, 64, 1024))
        match chance.randrange(8):
            case 0:
                for _ in range(chance.choice((1, 8, 64))):
                    at = chance.randrange(max(1, len(output)))
                    output[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                output[place : place + length] = bytes([chance.choice((0, 255, 127, 128))]) * length
            case 2:
                del output[place : place + length]
            case 3:
                output[place:place] = output[place : place + length]
            case 4:
                del output[place:]
            case 5:
                other = chance.choice(donors)
                output[place : place + length] = other[place : place + length]
            case 6:
                output += chance.randbytes(length)
            case 7:
                digits = [at for at, byte in enumerate(output[:65536]) if 48 <= byte < 58]
                if digits:
                    at = chance.choice(digits)
                    output[at : at + 1] = chance.choice(EXTREMES)
    return bytes(output)


def valid_files() -> list[tuple[str, bytes]]:
    """Kind and content of files that a service takes."""
    scene = tiny_scene.make_scene()
    files = [
        ("splats", scene.splats), ("cameras", scene.cameras), ("cameras", tiny_scene.colmap_zip()),
        ("features", scene.features), ("table", scene.table), ("photos", photos_zip("deflate")),
        ("masks", tiny_scene.masks({"left": np.zeros((24, 32)), "right": np.ones((24, 32))})),
    ]  # fmt: skip
    folder = ROOT / "tests/data/splats"
    of_editors = sorted(path for path in folder.iterdir() if not path.name.endswith(".decoded.ply"))
    return files + [("splats", path.read_bytes()) for path in of_editors]


def upload_loop(root: Path, count: int, seed: int) -> dict[str, Any]:
    """Upload changed files of every kind; what was answered."""
    files, tally, slowest = valid_files(), Tally(), 0.0
    with tempfile.TemporaryDirectory() as folder, Server(root, Path(folder) / "data").running() as server:

        def send(number: int) -> float:
            chance = random.Random(f"upload {seed} {number}")
            kind, content = files[number % len(files)]
            body = mutate_bytes(content, chance, [other for _, other in files])
            start = time.monotonic()
            reply = client.put(f"/assets/{kind}", content=body)
            tally.add(f"{kind} {number}", reply)
            return time.monotonic() - start

        with server.client() as client, ThreadPoolExecutor(CLIENTS) as pool:
            slowest = max(pool.map(send, range(count)))
            ready = client.get("/readyz").status_code
        remaining = server.left_over()
        return tally.figures() | {
            "slowest_seconds": round(slowest, 1),
            "ready": ready,
            "left_over": remaining,
            "tracebacks": server.tracebacks(),
        }


@dataclass
class Tally:
    """Answers by status, and those that break a promise: 5xx, refusals that are no problem, broken connections."""

    statuses: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)

    def add(self, label: str, reply: Any) -> None:
        """Count an answer of httpx, or the raw one of `exchange`."""
        status, kind = reply.status_code, reply.headers.get("content-type", "")
        self.statuses[str(status)] += 1
        framed = status == HTTPStatus.BAD_REQUEST and kind.startswith("text/plain")  # uvicorn's, for what is no HTTP
        if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            self.broken.append(f"{label}: {status} {reply.text[:300]}")
        elif status >= HTTPStatus.BAD_REQUEST and kind != "application/problem+json" and not framed:
            self.broken.append(f"{label}: {status} as {kind}")

    def figures(self) -> dict[str, Any]:
        """Both."""
        return {"sent": self.statuses.total(), "statuses": dict(sorted(self.statuses.items())), "broken": self.broken}


@dataclass(frozen=True)
class Request:
    """One that a service takes; a path may have parameters, a body is JSON."""

    method: str
    path: str
    parameters: dict[str, Any] = field(default_factory=dict)
    body: Any = None
    headers: dict[str, str] = field(default_factory=dict)


def valid_requests(lift: str, assets: dict[str, Any]) -> list[Request]:
    """List requests of a client of a lift; none deletes what a later one needs."""
    query = {"lift": lift, "text": "apple"}
    order = assets | {"settings": {"preset": "row-sum", "seed": 3, "objects": True}}
    camera = {"width": 16, "height": 12, "fx": 12.0, "fy": 12.0, "cx": 8.0, "cy": 6.0, "viewmat": tiny_scene.POSE}
    words = {"lift": lift, "words": ["apple", "book"]}
    reads = [
        ("/query", query | {"top": 3, "threshold": "auto"}), ("/query/objects", query | {"like": "middle:16,12"}),
        ("/query/mask", query | {"view": "left"}), ("/query/scores", query), ("/query/selection", query),
        ("/query/attention", query | {"view": "left", "unlike": "splat:1"}),
        ("/query/splats", query | {"what": "scores"}),
        ("/render", {"lift": lift, "view": "left", "what": "rgb"}), ("/lifts", {"limit": 2}), (f"/lifts/{lift}", {}),
        (f"/lifts/{lift}/features", {}), (f"/lifts/{lift}/splats", {}), (f"/lifts/{lift}/colours", {"what": "pca"}),
        (f"/lifts/{lift}/views", {}), (f"/lifts/{lift}/regions", {"view": "left", "x": 3, "y": 4}),
        (f"/lifts/{lift}/objects", {"limit": 2}), (f"/lifts/{lift}/objects/0/splats", {}), ("/assets", {"limit": 2}),
        (f"/assets/{assets['cameras']}", {}), (f"/assets/{assets['cameras']}/names", {"cursor": 0}),
        (f"/assets/{assets['cameras']}/content", {}), ("/jobs", {"limit": 2}), (f"/jobs/{lift}", {}),
        (f"/jobs/{lift}/events", {}), ("/healthz", {}), ("/version", {}), ("/openapi.json", {}), ("/", {}),
    ]  # fmt: skip
    bodies = [
        ("/query", query | {"text": ["apple"], "like": [[1.0] + [0.0] * 7]}),
        ("/query/mask", query | {"text": ["apple"], "camera": camera}),
        ("/query/objects", query | {"text": ["apple", "book"]}), ("/query/segment", words),
        ("/query/segment/labels", words), ("/query/segment/map", words | {"view": "left"}),
        ("/query/what", {"lift": lift, "example": "middle:16,12", "top": 2}),
        ("/render", {"lift": lift, "camera": camera, "what": "depth"}),
        ("/lift/plan", order), ("/lift", order), ("/tradeoff", assets | {"budget_s": 10}),
    ]  # fmt: skip
    requests = [Request("GET", path, parameters) for path, parameters in reads]
    requests += [Request("POST", path, body=body) for path, body in bodies]
    requests += [replace(requests[10], headers={"Range": "bytes=0-9", "If-None-Match": '"x"'})]
    requests += [
        replace(item, headers={"Idempotency-Key": item.path, "Last-Event-ID": "1"}) for item in requests[-4:-1]
    ]
    return [
        *requests,
        Request("PATCH", f"/lifts/{lift}", body={"name": "a name"}),
        Request("PATCH", f"/assets/{assets['features'][0]}", body={"encoder": "e", "text_space": "tiny"}),
        Request("DELETE", f"/jobs/{'0' * 32}"), Request("DELETE", f"/assets/sha256:{'0' * 64}"),
        Request("POST", f"/jobs/{lift}/cancel"), Request("PUT", "/assets/splats", {"sha256": "0" * 64}),
    ]  # fmt: skip


def change_request(request: Request, chance: random.Random) -> Request:
    """A request with something odd in one of its parts, mostly in what it asks."""
    parts = ["headers", "path", *["parameter", "parameter", "names"] * bool(request.parameters)]
    parts += ["body"] * 4 if request.body is not None else []
    names = [*request.parameters]
    match chance.choice(parts):
        case "parameter":
            name = chance.choice([name for name in names if name != "lift"] or names)
            value = str(request.parameters[name])
            at = chance.randrange(len(value) + 1)
            odd = chance.choice((value[:at] + chance.choice(CHARACTERS) + value[at:], chance.choice(CHARACTERS)))
            return replace(request, parameters=request.parameters | {name: odd})
        case "names":
            removed_name = chance.choice(names)
            parameters = {name: request.parameters[name] for name in names if name != removed_name}
            return replace(request, parameters=parameters | {chance.choice(["odd", "lift", "view", "q"]): "1"})
        case "body":
            return replace(request, body=_odd_somewhere(request.body, chance))
        case "headers":
            name = chance.choice(HEADERS)
            return replace(request, headers=request.headers | {name: chance.choice(CHARACTERS).strip()})
    at, odd = chance.randrange(1, len(request.path) + 1), quote(chance.choice(CHARACTERS[3:]), errors="replace")
    return replace(request, path=request.path[:at] + odd + request.path[at:])


def _odd_somewhere(value: Any, chance: random.Random) -> Any:
    if isinstance(value, dict) and value and chance.random() < 0.9:
        name = chance.choice([*value])
        if chance.random() < 0.15:
            return {key: item for key, item in value.items() if key != name}
        if chance.random() < 0.15:
            return value | {chance.choice(["odd", name.upper(), "settings"]): chance.choice(ODD)}
        return value | {name: _odd_somewhere(value[name], chance)}
    if isinstance(value, list) and value and chance.random() < 0.7:
        at = chance.randrange(len(value))
        return [*value[:at], _odd_somewhere(value[at], chance), *value[at + 1 :]]
    return chance.choice(ODD)


class RawReply:
    """An answer to bytes that a client library would not send."""

    def __init__(self, url: httpx.URL, request: Request, chance: random.Random) -> None:
        body = b"" if request.body is None else json.dumps(request.body).encode()
        headers = {"Content-Type": "application/json"} | request.headers if body else dict(request.headers)
        if body and chance.random() < 0.1:
            body = mutate_bytes(body, chance, [body])
        target = request.path + (f"?{urlencode(request.parameters, errors='replace')}" if request.parameters else "")
        connection = http.client.HTTPConnection(url.host, url.port or 80, timeout=600)
        lines = [f"{request.method} {target} HTTP/1.1", f"Host: {url.host}", "Connection: close"]
        lines += [f"Content-Length: {len(body)}"] if body or request.method in ("PUT", "POST", "PATCH") else []
        lines += [f"{name}: {value}" for name, value in headers.items()]
        head = "\r\n".join(lines).encode("utf-8", "replace")
        if waits := chance.random() < 0.05:
            head = mutate_bytes(head, chance, [head])
        connection.connect()
        connection.sock.sendall(head + b"\r\n\r\n" + body)
        connection.sock.settimeout(WAITING_SECONDS if waits else 600)
        reply = http.client.HTTPResponse(connection.sock, method=request.method)
        reply.begin()
        self.status_code, self.headers = reply.status, {name.lower(): value for name, value in reply.getheaders()}
        self.text = reply.read().decode("utf-8", "replace")
        connection.close()


def lifted(client: httpx.Client) -> tuple[str, dict[str, Any]]:
    """Upload the tiny scene and lift it; the lift and the body's assets."""
    scene = tiny_scene.make_scene()
    ids = {
        kind: client.put(f"/assets/{kind}", content=getattr(scene, kind)).raise_for_status().json()["id"]
        for kind in ("splats", "cameras", "features")
    }
    assets = ids | {"features": [ids["features"]]}
    job = client.post("/lift", json=assets | {"settings": {"preset": "row-sum"}}).raise_for_status().json()
    assert until_ended(client, job["id"])["state"] == "succeeded"
    return job["id"], assets


def until_ended(client: httpx.Client, job: str) -> dict[str, Any]:
    """The job once it has ended."""
    while (state := client.get(f"/jobs/{job}").json())["state"] not in FINAL_STATES:
        time.sleep(0.02)
    return state


def request_loop(root: Path, count: int, seed: int) -> dict[str, Any]:
    """Send changed requests of every route; what was answered. Jobs that come of it are canceled."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.safetensors"
        table.write_bytes(tiny_scene.make_scene().table)
        with Server(root, Path(folder) / "data", ("--encoder", f"table:{table}")).running() as server:
            with server.client() as client, ThreadPoolExecutor(CLIENTS) as pool:
                lift, assets = lifted(client)
                client.get("/query", params={"lift": lift, "text": "apple"}).raise_for_status()
                requests = valid_requests(lift, assets)
                valid = Tally()
                for request in requests:
                    valid.add(f"{request.method} {request.path}", RawReply(client.base_url, request, _Never()))

                def send(number: int) -> None:
                    chance = random.Random(f"request {seed} {number}")
                    request = requests[number % len(requests)]
                    for _ in range(chance.randint(1, 2)):
                        request = change_request(request, chance)
                    label = f"{number}: {request.method} {request.path[:80]} {str(request.parameters)[:120]}"
                    try:
                        tally.add(label, RawReply(client.base_url, request, chance))
                    except TimeoutError:
                        tally.statuses["waits for the rest"] += 1
                    except (OSError, http.client.HTTPException) as error:
                        tally.broken.append(f"{label}: {error!r}")
                    if number % 50 == 0:
                        _cancel_all(client)

                list(pool.map(send, range(count)))
                _cancel_all(client)
                ready = client.get("/readyz").status_code
            tracebacks = server.tracebacks()
    unchanged = {"unchanged": dict(valid.statuses), "broken_unchanged": valid.broken}
    return tally.figures() | unchanged | {"ready": ready, "tracebacks": tracebacks}


class _Never(random.Random):
    """Chance that changes nothing."""

    def random(self) -> float:
        return 1.0


def _cancel_all(client: httpx.Client) -> None:
    for job in client.get("/jobs").json()["jobs"]:
        if job["state"] not in FINAL_STATES:
            client.post(f"/jobs/{job['id']}/cancel")


def key_loop(root: Path, count: int, seed: int) -> dict[str, Any]:
    """Ask with no key, changed keys, ended keys and keys of other scopes; answers that are not as they must be."""
    routes = (
        ("GET", "/lifts", "read"), ("GET", "/jobs", "read"), ("GET", f"/assets/sha256:{'0' * 64}/content", "read"),
        ("GET", "/query?text=apple", "read"), ("POST", "/lift", "write"), ("POST", "/lift/plan", "write"),
        ("PUT", "/assets/table", "write"), ("DELETE", f"/jobs/{'0' * 32}", "write"), ("GET", "/metrics", "metrics"),
        ("PATCH", f"/lifts/{'0' * 32}", "write"), ("GET", "/nowhere", "read"), ("POST", "/query", "read"),
    )  # fmt: skip
    tally, wrong = Tally(), []
    with tempfile.TemporaryDirectory() as folder:
        server = Server(root, Path(folder) / "data")
        keys = {scope: _new_key(server, scope) for scope in ("read", "write", "metrics", "admin")}
        revoked = _new_key(server, "admin")
        _command(server, "revoke", revoked["id"])
        rotated = _new_key(server, "admin")
        _command(server, "rotate", rotated["id"])
        expired = _new_key(server, "admin", "--expires", "1s")
        time.sleep(1.5)
        with server.running(), server.client() as client:

            def send(number: int) -> None:
                chance = random.Random(f"key {seed} {number}")
                method, path, required_scope = routes[number % len(routes)]
                headers, scope = _credentials(chance, keys, [revoked["key"], rotated["key"], expired["key"]])
                if chance.random() < 0.1:
                    path += f"{'&' if '?' in path else '?'}key={keys['admin']['key']}"
                reply = client.request(method, path, headers=headers, content=b"" if method != "GET" else None)
                tally.add(f"{method} {path}", reply)
                is_allowed = scope in (required_scope, "admin")
                as_promised = (
                    reply.status_code not in (401, 403) if is_allowed
                    else reply.status_code == (401 if scope is None else 403)
                )  # fmt: skip
                if not as_promised:
                    wrong.append(f"{number}: {method} {path} {headers} by {scope}: {reply.status_code}")

            with ThreadPoolExecutor(CLIENTS) as pool:
                list(pool.map(send, range(count)))
            with server.client(Authorization=f"Bearer {keys['admin']['key']}") as boss:
                row_count = sum(len(boss.get(f"/{name}").json()[name]) for name in ("jobs", "assets"))
        secrets = [key["key"] for key in (*keys.values(), revoked, rotated, expired)]
        files = [server.log, *(path for path in server.data.rglob("*") if path.is_file())]
        leaked = sum(secret.encode() in path.read_bytes() for path in files for secret in secrets)
        tracebacks = server.tracebacks()
    return tally.figures() | {"wrong": wrong, "made": row_count, "secrets_in_files": leaked, "tracebacks": tracebacks}


def _credentials(
    chance: random.Random, keys: dict[str, dict[str, str]], final: list[str]
) -> tuple[list[tuple[str, str]], str | None]:
    """Headers, and the scope that they bring; None where they bring none."""
    scope = chance.choice([*keys])
    secret = keys[scope]["key"]
    at = chance.randrange(len(secret))
    other = chr((ord(secret[at]) - 32) % 90 + 33)
    bad: list[Callable[[], list[str]]] = [
        list, lambda: [f"Bearer {secret[:at]}{other}{secret[at + 1:]}"], lambda: [f"Bearer {secret[:at]}"],
        lambda: [f"Bearer {chance.choice(final)}"], lambda: [f"Basic {secret}"], lambda: [secret], lambda: ["Bearer"],
        lambda: [f"Bearer {secret} {secret}"], lambda: [f"Bearer {secret}", f"Bearer {secret}"],
        lambda: [f"Bearer {chance.randbytes(32).hex()}"], lambda: [f"Bearer {secret.swapcase()}"],
        lambda: [f"Bearer {secret}{other}"], lambda: ["Bearer " + "a" * 5000],
    ]  # fmt: skip
    if chance.random() < 0.35:
        return [("Authorization", f"{chance.choice(['Bearer', 'bearer'])} {secret}")], scope
    return [("Authorization", value) for value in chance.choice(bad)()], None


def _command(server: Server, action: str, *options: str) -> dict[str, Any]:
    command = [server.python, "-m", "liftcore.cli", "keys", action, "--json", "--data", str(server.data), *options]
    return json.loads(subprocess.run(command, cwd=server.root, capture_output=True, check=True).stdout)


def _new_key(server: Server, scopes: str, *options: str) -> dict[str, Any]:
    return _command(server, "create", "--name", f"{scopes}-{time.monotonic_ns()}", "--scopes", scopes, *options)


def cancel_loop(root: Path, count: int, seed: int) -> dict[str, Any]:
    """Cancel lifts at random moments; how long `canceled` took, and whether a process was left then."""
    chance, seconds = random.Random(f"cancel {seed}"), []
    stages, figures = Counter[str](), Counter[str](canceled=0, succeeded=0, late=0, processes_left=0, changed_later=0)
    with tempfile.TemporaryDirectory() as folder:
        files = scene_files(Path(folder), views=30, splats=20_000, width=320)
        with Server(root, Path(folder) / "data").running() as server, server.client() as client:
            ids = {kind: client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in files.items()}
            body = ids | {"features": [ids["features"]]}
            start = time.monotonic()
            until_ended(client, client.post("/lift", json=body | {"settings": {"seed": 1}}).json()["id"])
            total = time.monotonic() - start
            jobs = []
            while len(seconds) < count:
                number = len(jobs) + 2
                jobs.append(
                    client.post("/lift", json=body | {"settings": {"seed": number}}).raise_for_status().json()["id"]
                )
                time.sleep(chance.uniform(0, total))
                now = client.get(f"/jobs/{jobs[-1]}").json()
                stage = now["state"] if now["progress"] is None else now["progress"]["stage"]
                start = time.monotonic()
                reply = client.post(f"/jobs/{jobs[-1]}/cancel")
                final = until_ended(client, jobs[-1])
                if final["state"] == "succeeded":  # before the cancel, which was refused then, or had nothing to end
                    figures["succeeded"] += 1
                    continue
                assert reply.is_success, reply.text
                seconds.append(time.monotonic() - start)
                figures["processes_left"] += len(processes_of(jobs[-1]))
                figures[final["state"]] += 1
                figures["late"] += seconds[-1] > CANCEL_SECONDS
                stages[stage] += 1
            figures["changed_later"] = sum(
                client.get(f"/lifts/{job}").is_success != (client.get(f"/jobs/{job}").json()["state"] == "succeeded")
                for job in jobs
            )
            remaining = server.left_over()
        tracebacks = server.tracebacks()
    durations = {"median_seconds": round(float(np.median(seconds)), 2), "longest_seconds": round(max(seconds), 2)}
    return {"canceled_while": stages, **figures, **durations, "left_over": remaining, "tracebacks": tracebacks}


LOOPS: dict[str, tuple[int, Callable[[Path, int, int], dict[str, Any]]]] = {
    "uploads": (2000, upload_loop),
    "requests": (3000, request_loop),
    "keys": (500, key_loop),
    "cancels": (40, cancel_loop),
}
BROKEN = ("broken", "broken_unchanged", "wrong", "left_over", "tracebacks", "secrets_in_files", "made", "late",
          "processes_left", "changed_later", "failed")  # fmt: skip


def main() -> int:
    """Run the loops whose counts are not 0; 1 when a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.mutations", description=__doc__)
    for name, (count, loop) in LOOPS.items():
        parser.add_argument(f"--{name}", type=int, default=count, help=(loop.__doc__ or "").partition(";")[0].lower())
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout whose service is asked")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    figures: dict[str, Any] = {**machine()}
    for name, (_, loop) in LOOPS.items():
        if count := getattr(options, name):
            start = time.monotonic()
            figures[name] = loop(options.root, count, options.seed)
            figures[name]["seconds"] = round(time.monotonic() - start)
    print(json.dumps(figures, indent=2))
    return int(any(figures[name].get(fault) for name in LOOPS if name in figures for fault in BROKEN))


if __name__ == "__main__":
    sys.exit(main())
