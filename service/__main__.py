"""``python -m service``: the service on this machine."""

from __future__ import annotations

import argparse
import ipaddress
import logging
import socket
import sys
from collections.abc import Sequence
from typing import Any

import uvicorn
from pydantic import ValidationError

from liftcore.errors import SplatliftError
from service.app import assemble, pace_of
from service.connection import watched
from service.errors import Misconfigured
from service.jobs.streams import EventStreams
from service.settings import ServiceSettings
from service.store.store import Store


class AnnouncingServer(uvicorn.Server):
    """Says on stdout where it listens, once it does, and to streams that it ends, before it waits for their end."""

    def __init__(self, config: uvicorn.Config, streams: EventStreams) -> None:
        super().__init__(config)
        self._streams = streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop in order."""
        self._streams.close()
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then say so."""
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            print(f"listening on http://{shown}:{port}", flush=True)


def parse(arguments: Sequence[str]) -> ServiceSettings:
    """Settings from the command line, else from the environment, else their defaults.

    Raises:
        Misconfigured: a value that a setting does not take.
    """
    parser = argparse.ArgumentParser(
        prog="python -m service", description=__doc__, argument_default=argparse.SUPPRESS
    )
    parser.add_argument("--host", help="the address to bind; loopback only")
    parser.add_argument("--port", type=int, help="the port to bind; 0 picks a free one")
    parser.add_argument("--data", help="the directory for the database and all files")
    parser.add_argument("--encoder", metavar="SPEC", help="the default text encoder: minilm, table:FILE, ...")
    parser.add_argument(
        "--text-space", action="append", dest="text_spaces", metavar="NAME=SPEC",
        help="the text encoder of a text space; may be given several times",
    )  # fmt: skip
    given: dict[str, Any] = vars(parser.parse_args(arguments))
    if "text_spaces" in given:
        pairs = [text.partition("=") for text in given["text_spaces"]]
        for name, _, spec in pairs:
            if not (name and spec):
                raise Misconfigured("--text-space", expected="NAME=SPEC", got=repr(f"{name}={spec}"))
        given["text_spaces"] = {name: spec for name, _, spec in pairs}
    try:
        return ServiceSettings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise Misconfigured(name, expected=first["msg"].lower(), got=repr(first["input"])) from None


def bind(host: str, port: int) -> socket.socket:
    """A listening socket on a loopback address.

    Raises:
        Misconfigured: the address is not loopback, or it is taken.
    """
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise Misconfigured(
            "host", expected="a loopback address such as 127.0.0.1", got=host,
            hint="this release has no access keys, so only this machine may reach it; keys are to come",
        )  # fmt: skip
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise Misconfigured("port", expected="a free port", got=f"{port}: {error.strerror}") from None
    return listener


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the service until it is told to stop; the exit status."""
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
    try:
        settings = parse(sys.argv[1:] if arguments is None else arguments)
        listener = bind(settings.host, settings.port)
        store = Store.open(settings.data, floor_bytes=settings.disk_floor_bytes)
    except SplatliftError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        app = assemble(settings, store)
        connection = watched(pace_of(settings), settings.max_connections)
        config = uvicorn.Config(app, http=connection, log_level="warning", server_header=False)
        AnnouncingServer(config, app.state.streams).run(sockets=[listener])
    finally:
        store.close()
        listener.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
