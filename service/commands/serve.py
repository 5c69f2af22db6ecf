"""``splatlift serve``: run the service on this machine."""

from __future__ import annotations

import argparse
import gc
import json
import resource
import signal
import socket
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import FrameType

import anyio
import uvicorn
from fastapi import FastAPI

from liftcore.cli import Parser
from service.app import create_app, logging_to_stderr
from service.auth import is_loopback
from service.errors import Misconfigured
from service.settings import ServiceSettings, read_settings, require_encoder_files, variables
from service.store import DATABASE, Store, connect, list_keys

CONNECTIONS = 400  # that may be open; requests over more get 503
STOP_SECONDS = 10  # that open requests have to end in a stop
# Seconds that a connection is kept after an answer: more than in the pools of clients and proxies (nginx 60 s). With
# an equal number a client may send its next request while the server closes the connection.
KEEP_ALIVE_SECONDS = 75
SWITCH_SECONDS = 0.0005  # of computation by a thread while the event loop waits; a tenth of Python's default


class AnnouncingServer(uvicorn.Server):
    """Announce the address after the start, and stop in order: a stop by a signal is no failure."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, announce: Callable[[str], None]) -> None:
        super().__init__(config)
        self._app, self._announce = app, announce

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at the first signal, at once at a second SIGINT. uvicorn would raise the signal after the stop."""
        self.force_exit = self.force_exit or (self.should_exit and sig == signal.SIGINT)
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then announce the address."""
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            self._announce(f"http://{f'[{host}]' if ':' in host else host}:{port}")

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Put running jobs back in line and end streams of events while the port still answers, then close it."""
        await anyio.to_thread.run_sync(self._app.state.parts.runner.stop)
        await super().shutdown(sockets)


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("--host", help="the address to bind; beyond loopback only with keys")
    parser.add_argument("--port", type=int, help="the port to bind; 0 picks a free one")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the directory for the database and all files")
    parser.add_argument("--encoder", metavar="SPEC", help="the default text encoder: lvis, table:FILE, ...")
    parser.add_argument("--settings", action="store_true", help="list all environment variables, and exit")


def run(options: argparse.Namespace) -> int:
    """Run the service until it is stopped, or list its settings."""
    if options.settings:
        rows = list(variables())
        lines = (f"{name}={default}\n    {meaning}" for name, default, meaning in rows)
        print(json.dumps({"settings": rows}) if options.json else "\n".join(lines))
        return 0
    settings = read_settings(**{name: getattr(options, name) for name in ("host", "port", "data", "encoder")})
    require_keys(settings)
    require_encoder_files(settings)

    def announce(address: str) -> None:
        document = json.dumps({"address": address, "data": str(settings.data.absolute())})
        print(document if options.json else f"listening on {address}", flush=True)

    serve(settings, announce)
    return 0


def serve(
    settings: ServiceSettings, announce: Callable[[str], None], prepare: Callable[[Store], None] = lambda _: None
) -> None:
    """Run a server until it is stopped: `prepare` the store, start, then `announce` the address."""
    with closing(bind(settings.host, settings.port)) as listener, logging_to_stderr():
        with data_directory_errors():
            store = Store(settings.data, settings.disk_floor_bytes)
        with closing(store):
            prepare(store)
            hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
            with suppress(ValueError, OSError):  # some kernels have a lower limit than they report
                resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            sys.setswitchinterval(SWITCH_SECONDS)
            app = create_app(settings, store)
            gc.freeze()  # what is there now is no garbage: a search through it would stop all answers for .1 s
            server_of(app, settings, announce).run(sockets=[listener])


def server_of(app: FastAPI, settings: ServiceSettings, announce: Callable[[str], None]) -> AnnouncingServer:
    """Return the server of an application, which announces its address."""
    config = uvicorn.Config(
        app, http="h11", ws="none", log_config=None, log_level="warning", access_log=False, server_header=False,
        limit_concurrency=CONNECTIONS + 1,  # including the current one
        timeout_keep_alive=KEEP_ALIVE_SECONDS, timeout_graceful_shutdown=STOP_SECONDS,
        proxy_headers=bool(settings.forwarded_allow), forwarded_allow_ips=settings.forwarded_allow,
    )  # fmt: skip
    return AnnouncingServer(config, app, announce)


@contextmanager
def data_directory_errors() -> Iterator[None]:
    """Convert errors of the disk and the database to one line: full, read-only or failing."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise Misconfigured("data", expected="a directory to read and write", got=str(error)) from error


def require_keys(settings: ServiceSettings) -> None:
    """Require keys if the service is reachable from other machines."""
    if is_loopback(settings.host):
        return
    with data_directory_errors():
        path = settings.data / DATABASE
        if path.exists():
            with closing(connect(path, "ro")) as connection:
                if list_keys(connection):
                    return
    raise Misconfigured(
        "host", expected="a loopback address such as 127.0.0.1, as there are no keys", got=settings.host,
        hint=f"make one first: splatlift keys create --name NAME --scopes read,write --data {settings.data}",
    )  # fmt: skip


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio disables Nagle's algorithm only if TCP is named; else answers on kept connections wait 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        got = f"{host} port {port}: {error.strerror}"
        raise Misconfigured("host", expected="an address of this machine, with a free port", got=got) from None
    return listener
