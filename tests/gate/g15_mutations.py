"""Uploads changed at random: each is stored or refused by a problem (RFC 9457), and none is a 5xx.

python -m tests.gate.g15_mutations [--uploads N]
"""

from __future__ import annotations

import argparse
import random
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx

from tests import tiny_scene
from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import small_scene

CLIENTS = 2
NUMBERS = (b"0", b"-1", b"1e999", b"NaN", b"4294967296", b"9" * 400, b"18446744073709551617")


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Send them; look at all answers, the log and the scratch folders."""
    with Service(folder / "data") as service:
        contents = [
            *small_scene().items(),
            ("cameras", tiny_scene.colmap_zip()),
            ("splats", tiny_scene.ply(tiny_scene.splat_rows())),
        ]

        def send_upload(number: int) -> httpx.Response:
            chance = random.Random(f"upload {options.seed} {number}")
            kind, content = contents[number % len(contents)]
            mutated = mutate_bytes(content, chance, [other for _, other in contents])
            return service.client.put(f"/assets/{kind}", content=mutated)

        with ThreadPoolExecutor(CLIENTS) as pool:
            replies = list(pool.map(send_upload, range(options.uploads)))
        statuses = dict(sorted(Counter(reply.status_code for reply in replies).items()))
        faults = [reply.text[:200] for reply in replies if reply.is_server_error]
        verdicts.check(f"{options.uploads} changed uploads: none is a 5xx", not faults, f"{statuses} {faults[:2]}")
        no_problems = [
            reply.text[:200]
            for reply in replies
            if reply.is_client_error and "problem+json" not in reply.headers["content-type"]
        ]
        verdicts.check("their refusals are problems", not no_problems, no_problems[:2])
        verdicts.check("the service is ready", service.client.get("/readyz").status_code == 200)
        verdicts.check("nothing lies in the scratch folders", not service.scratch(), service.scratch())
        tracebacks = service.log.read_text().count("Traceback")
        verdicts.check("the log has no traceback", not tracebacks, tracebacks)


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


if __name__ == "__main__":
    run_gate(gate, __doc__, uploads=60)
