"""Clients that take their time, in a process of their own.

Run as ``python -m tests.load.tricklers PORT PATH SOCKETS READERS``.

Half of the sockets trickle uploads: every other one at twice the least speed, the rest a byte at a time. A quarter
trickles headers and a quarter JSON bodies, a byte at a time. Readers ask for PATH and read a little of it now and
then. Whoever is cut off comes back at once. Talks to 127.0.0.1 only. Says when all have come, and ends when its stdin
does, with one line of JSON: how many connections are open, and how often each kind was cut off.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections import Counter
from dataclasses import dataclass

HOST = "127.0.0.1"
ALL_CAME = "all have come"
PAUSE_SECONDS = 0.5
UPLOAD = b"PUT /assets/splats HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 50000000\r\n\r\nply\n"
ORDER = b"POST /lift HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 50000\r\n\r\n{"
HEADERS = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "
LEAST = 1024  # bytes a second, the service's default


@dataclass(frozen=True)
class Kind:
    """A way to be slow."""

    name: str
    begin: bytes
    drop: bytes = b" "  # what is sent at each pause
    read: int = 0  # what is read at each pause; 0 reads nothing


def kinds(sockets: int, readers: int, path: str) -> list[Kind]:
    """One for each connection."""
    quarter = sockets // 4
    download = Kind("download", f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode(), b"", 2_000)
    return [
        *[Kind("upload", UPLOAD)] * quarter,
        *[Kind("steady upload", UPLOAD, b" " * round(2 * LEAST * PAUSE_SECONDS))] * quarter,
        *[Kind("headers", HEADERS, b"a")] * quarter,
        *[Kind("body", ORDER)] * (sockets - 3 * quarter),
        *[download] * readers,
    ]


async def keep_coming(kind: Kind, port: int, cut: Counter[str], live: Counter[str], came: asyncio.Event) -> None:
    """One slow client for ever; ``came`` is set when it is connected for the first time."""
    while True:
        with contextlib.suppress(OSError):
            reader, writer = await asyncio.open_connection(HOST, port, limit=1 << 12)
            live[kind.name] += 1
            came.set()
            try:
                await be_slow(kind, reader, writer)
            finally:
                live[kind.name] -= 1
                cut[kind.name] += 1
                writer.close()
        await asyncio.sleep(0.05)


async def be_slow(kind: Kind, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Until the server has had enough."""
    writer.write(kind.begin)
    while True:
        await asyncio.sleep(PAUSE_SECONDS)
        if kind.read:
            if not await reader.read(kind.read):
                return
            continue
        if reader.at_eof() or writer.is_closing():
            return
        writer.write(kind.drop)
        await writer.drain()


async def main() -> None:
    """Trickle until stdin ends."""
    port, path, sockets, readers = int(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    cut: Counter[str] = Counter()
    live: Counter[str] = Counter()
    chosen = kinds(sockets, readers, path)
    came = [asyncio.Event() for _ in chosen]
    tasks = [
        asyncio.create_task(keep_coming(kind, port, cut, live, first))
        for kind, first in zip(chosen, came, strict=True)
    ]
    for first in came:
        await first.wait()
    print(ALL_CAME, flush=True)
    await asyncio.to_thread(sys.stdin.read)
    told = {"open": dict(live), "cut_off": dict(cut)}
    for task in tasks:
        task.cancel()
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    asyncio.run(main())
