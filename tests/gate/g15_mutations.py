"""Uploads and requests changed at random: refusals are problems (RFC 9457), and none is a 5xx.

python -m tests.gate.g15_mutations [--uploads N] [--requests N]
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from tests import tiny_scene
from tests.gate.running import FINAL_STATES, Service, Verdicts, run_gate
from tests.gate.scenes import small_scene

CLIENTS = 2
SECONDS = 60  # for an answer
NUMBERS = (b"0", b"-1", b"1e999", b"NaN", b"4294967296", b"9" * 400, b"18446744073709551617")
VALUES = (None, True, -1, 0, 10**400, 1e308, "", "\ud800", "\0", "a" * 5000, [], {}, [[]], [None], {"a": {}})
TEXTS = ("", "\0", "%", "\r\n", "a" * 3000, "../..", "\ud800", "9" * 400, "-1", "nan", "v0:0,0", "\u2028")
HEADERS = ("Range", "If-None-Match", "Content-Type", "Idempotency-Key", "Last-Event-ID", "Accept", "Origin")
Request = tuple[str, str, dict[str, Any], Any]  # method, path, parameters, body


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Send both kinds; look at all answers, the log and the scratch folders."""
    with Service(folder / "data") as service:
        files = small_scene()
        body = service.upload(files)
        lift = service.order(body)
        service.wait_for(lift)
        contents = [
            *files.items(),
            ("cameras", tiny_scene.colmap_zip()),
            ("splats", tiny_scene.ply(tiny_scene.splat_rows())),
        ]
        requests = valid_requests(lift, body)

        def send_upload(number: int) -> tuple[int, str, str]:
            chance = random.Random(f"upload {options.seed} {number}")
            kind, content = contents[number % len(contents)]
            mutated = mutate_bytes(content, chance, [other for _, other in contents])
            return exchange(service, ("PUT", f"/assets/{kind}", {}, mutated), {})

        def send_request(number: int) -> tuple[int, str, str]:
            chance = random.Random(f"request {options.seed} {number}")
            request, headers = mutate_request(requests[number % len(requests)], chance)
            if number % 50 == 0:
                cancel_all(service)
            return exchange(service, request, headers)

        answers = [exchange(service, request, {}) for request in requests]
        wrong = [answer for answer in answers if answer[0] not in (200, 202)]
        verdicts.check(
            "unchanged requests are answered 200 or 202", not wrong, wrong[:2] or f"{len(requests)} of them"
        )
        check_answers(f"{options.uploads} changed uploads", send_upload, range(options.uploads), verdicts)
        check_answers(f"{options.requests} changed requests", send_request, range(options.requests), verdicts)
        cancel_all(service)
        verdicts.check("the service is ready", service.get("/readyz").status_code == 200)
        verdicts.check("nothing lies in the scratch folders", not service.scratch(), service.scratch())
        tracebacks = service.log.read_text().count("Traceback")
        verdicts.check("the log has no traceback", not tracebacks, tracebacks)


def check_answers(
    name: str, send: Callable[[int], tuple[int, str, str]], numbers: Iterable[int], verdicts: Verdicts
) -> None:
    """Send all, and judge the answers."""
    with ThreadPoolExecutor(CLIENTS) as pool:
        answers = list(pool.map(send, numbers))
    statuses = dict(sorted(Counter(status for status, _, _ in answers).items()))
    faults = [answer for answer in answers if answer[0] >= 500]
    verdicts.check(f"{name}: none is a 5xx", not faults, f"{statuses} {faults[:2]}")
    # uvicorn answers what is no HTTP by plain text
    no_problems = [
        it for it in answers if 400 <= it[0] < 500 and "problem+json" not in it[1] and "text/plain" not in it[1]
    ]
    verdicts.check("their refusals are problems", not no_problems, no_problems[:2])


def exchange(service: Service, request: Request, headers: dict[str, str]) -> tuple[int, str, str]:
    """Status, content type and what was asked, and how the answer begins; status 0 where none came."""
    method, path, parameters, body = request
    target = path + (f"?{urlencode(parameters, errors='replace')}" if parameters else "")
    content = body if isinstance(body, bytes) else json.dumps(body).encode() if body is not None else b""
    lines = [f"{method} {target} HTTP/1.1", "Host: localhost", "Connection: close"]
    lines += [f"Content-Length: {len(content)}"] if method != "GET" else []
    lines += [f"{name}: {value}" for name, value in ({"Content-Type": "application/json"} | headers).items()]
    connection = http.client.HTTPConnection("127.0.0.1", service.base_url.port or 80, timeout=SECONDS)
    try:
        connection.connect()
        connection.sock.sendall("\r\n".join([*lines, "", ""]).encode("utf-8", "replace") + content)
        reply = http.client.HTTPResponse(connection.sock, method=method)
        reply.begin()
        text = reply.read().decode("utf-8", "replace")
        return reply.status, reply.getheader("content-type", ""), f"{method} {target[:100]} {headers}: {text[:200]}"
    except (OSError, http.client.HTTPException) as error:
        return 0, "", f"{method} {target[:100]}: {error!r}"
    finally:
        connection.close()


def valid_requests(lift: str, body: dict[str, Any]) -> list[Request]:
    """Requests that a client of a lift sends."""
    query = {"lift": lift, "text": "apple", "table": body["table"]}
    view = {"lift": lift, "view": "v0"}
    order = {name: body[name] for name in ("splats", "cameras", "features")}
    reads = [
        ("/query", query | {"top": 3, "threshold": "auto"}), ("/query", {"lift": lift, "like": "v1:16,12"}),
        ("/query/objects", query), ("/query/mask", query | view), ("/query/scores", query), ("/query/object", query),
        ("/query/suggested_words", {"lift": lift, "table": body["table"]}), ("/render", view | {"channel": "rgb"}),
        ("/lifts", {"limit": 2}), (f"/lifts/{lift}", {}), (f"/lifts/{lift}/features", {}),
        (f"/lifts/{lift}/objects", {"limit": 2}), (f"/lifts/{lift}/tree", {}), (f"/lifts/{lift}/selections", {}),
        ("/assets", {"limit": 2}), (f"/assets/{body['splats']}", {}), (f"/assets/{body['splats']}/content", {}),
        ("/jobs", {"limit": 2}), (f"/jobs/{lift}", {}), (f"/jobs/{lift}/events", {}), ("/openapi.json", {}),
    ]  # fmt: skip
    settings = {"settings": {"preset": "row-sum", "seed": 3}}
    bodies = [
        ("/query", query | {"text": ["apple"]}), ("/query/mask", query | view | {"text": ["apple", "book"]}),
        ("/query/segment", {"lift": lift, "table": body["table"], "words": ["apple", "book"]}),
        ("/query/export", {"lift": lift, "table": body["table"], "words": ["apple"]}),
        ("/lift/plan", order | settings), ("/lift", order | settings), ("/tradeoff", order | {"budget_s": 10}),
    ]  # fmt: skip
    return [("GET", path, values, None) for path, values in reads] + [
        ("POST", path, {}, item) for path, item in bodies
    ]


def mutate_request(request: Request, chance: random.Random) -> tuple[Request, dict[str, str]]:
    """A request with something odd in its path, a parameter, a header or its body; and the headers."""
    method, path, parameters, body = request
    parts = ["header", "path", *["parameter"] * 3 * bool(parameters), *["body"] * 5 * (body is not None)]
    match chance.choice(parts):
        case "header":
            return request, {chance.choice(HEADERS): chance.choice(TEXTS).strip()}
        case "parameter":
            name = chance.choice([*parameters, "odd"])
            return (method, path, parameters | {name: chance.choice(TEXTS)}, body), {}
        case "body" if chance.random() < 0.2:
            content = json.dumps(body).encode()
            return (method, path, parameters, mutate_bytes(content, chance, [content])), {}
        case "body":
            return (method, path, parameters, mutate_value(body, chance)), {}
    index = chance.randrange(1, len(path) + 1)
    return (
        method,
        path[:index] + quote(chance.choice(TEXTS[1:]), errors="replace") + path[index:],
        parameters,
        body,
    ), {}


def mutate_value(value: Any, chance: random.Random) -> Any:
    """JSON with one value, somewhere, that is odd, missing or of no known name."""
    if isinstance(value, dict) and value and chance.random() < 0.9:
        name = chance.choice([*value])
        if chance.random() < 0.15:
            return {key: value[key] for key in value if key != name}
        return value | {chance.choice([name] * 6 + ["odd"]): mutate_value(value[name], chance)}
    if isinstance(value, list) and value and chance.random() < 0.7:
        return [mutate_value(value[0], chance), *value[1:]]
    return chance.choice(VALUES)


def mutate_bytes(content: bytes, chance: random.Random, donors: list[bytes]) -> bytes:
    """Bytes changed in one to three places, mostly near their beginning."""
    output = bytearray(content)
    for _ in range(chance.randint(1, 3)):
        start = chance.randrange(len(output) // chance.choice((1, 8)) + 1)
        end = start + chance.choice((1, 4, 8, 64, 1024))
        match chance.randrange(6):
            case 0:
                output[start:end] = chance.randbytes(end - start)
            case 1:
                output[start:end] = bytes([chance.choice((0, 255, 127, 128))]) * (end - start)
            case 2:
                del output[start:end]
            case 3:
                del output[start:]
            case 4:
                output[start:end] = chance.choice(donors)[start:end]
            case 5 if digits := [index for index, byte in enumerate(output[:65536]) if 48 <= byte < 58]:
                index = chance.choice(digits)
                output[index : index + 1] = chance.choice(NUMBERS)
    return bytes(output)


def cancel_all(service: Service) -> None:
    """Cancel the jobs that have not ended, and wait for their ends."""
    for record in service.get("/jobs", params={"limit": 1000}).json()["jobs"]:
        if record["state"] not in FINAL_STATES:
            service.post(f"/jobs/{record['id']}/cancel")
            service.wait_for(record["id"])


if __name__ == "__main__":
    run_gate(gate, __doc__, uploads=60, requests=120)
