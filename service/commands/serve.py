"""``splatlift serve``, which is ``python -m service``: the service on this machine."""

from __future__ import annotations

import argparse
import gc
import json
import logging
import math
import os
import resource
import signal
import socket
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from textwrap import fill
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from liftcore.cli import Parser
from service.app import assemble
from service.auth import is_loopback
from service.errors import Misconfigured
from service.observe import logging_to_stderr
from service.settings import REMOVED_VARIABLES, ServiceSettings, read_settings, require_encoder_files, variables
from service.state import Stopping
from service.store.database import DATABASE, keys_were_made, require_database
from service.store.keys import any_key
from service.store.store import Store

FILES_A_CONNECTION = 2  # itself, and what it is sent
SWITCH_SECONDS = 0.0005  # that a thread may compute on while the event loop waits; Python's own is ten times that
MARGIN = " " * 6  # of what --help says of a variable
# That a connection is kept after an answer: longer than the pools of clients and proxies keep theirs (httpx 5 s,
# aiohttp 15 s, nginx 60 s). At the same number one sends its next request in the moment in which it is closed.
KEEP_ALIVE_SECONDS = 75
IDLE_SECONDS = 1.0  # without a request in progress; then a connection may be closed for one that comes
FILES_BESIDE = 128  # of the database, checks, jobs and the query worker

log = logging.getLogger(__name__)


class AnnouncingServer(uvicorn.Server):
    """Says on stdout where it listens, once it does, and stops in order: what it is told to stop by is no failure.

    Connections without a request in progress make room for others: uvicorn's own limit looks at requests alone, and
    waits for ever for who sends nothing.
    """

    def __init__(
        self, config: uvicorn.Config, stopping: Stopping, max_connections: int, announce: Callable[[str], None]
    ) -> None:
        super().__init__(config)
        self._max_connections = max_connections
        self._stopping = stopping
        self._announce = announce
        # Connection and the last request of it, which is over -> seconds of the monotonic clock
        self._idle_since: dict[tuple[Any, Any], float] = {}

    async def on_tick(self, counter: int) -> bool:
        """Close the connections that are idle the longest where the next one would be too many. uvicorn calls this
        ten times a second.
        """
        now, connections = time.monotonic(), self.server_state.connections
        requests = ((each, getattr(each, "cycle", None)) for each in connections)
        self._idle_since = {
            last: self._idle_since.get(last, now)  # another request since the last look: idle from now on
            for last in requests
            if last[1] is None or last[1].response_complete
        }
        surplus = len(connections) - self._max_connections + 1  # with the next one
        for last in sorted(self._idle_since, key=self._idle_since.__getitem__)[: max(0, surplus)]:
            if now - self._idle_since[last] >= IDLE_SECONDS and not last[0].transport.is_closing():
                last[0].shutdown()
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at the first signal; at a second SIGINT at once. uvicorn would die of the signal after the stop."""
        self.force_exit = self.force_exit or (self.should_exit and sig == signal.SIGINT)
        self.should_exit = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Refuse work and put back what runs while the port still answers, then close it."""
        await self._stopping.begin(lambda: self.force_exit)
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then say so."""
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            name = f"[{host}]" if ":" in host else host
            self._announce(f"http://{name}:{port}")


def say(address: str) -> None:
    """Tell people where the server listens."""
    print(f"listening on {address}", flush=True)


def say_in_json(address: str, data: Path) -> None:
    """Tell programs, and where everything lies."""
    print(json.dumps({"address": address, "data": str(data.absolute())}), flush=True)


def add_arguments(parser: Parser) -> None:
    """The options of the command; the end of its help lists all settings."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, told_variables()
    parser.add_argument("--host", help="the address to bind; beyond loopback only with keys")
    parser.add_argument("--port", type=int, help="the port to bind; 0 picks a free one")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the directory for the database and all files")
    parser.add_argument("--encoder", metavar="SPEC", help="the default text encoder: lvis, table:FILE, ...")
    of_space = "the text encoder of a text space; may be given several times"
    parser.add_argument("--text-space", action="append", dest="text_spaces", metavar="NAME=SPEC", help=of_space)
    new_help = "where the database is gone or older than the files, begin an empty one; the files go to quarantine"
    parser.add_argument("--new", action="store_true", help=new_help)


def run(options: argparse.Namespace) -> int:
    """Run the service until it is stopped."""
    settings = settings_of(options)
    with data_directory_errors():
        if not options.new:
            require_database(settings.data / DATABASE)
        require_keys(settings)
        require_encoder_files(settings)
        require_files(settings)
        listener = bind(settings.host, settings.port)
        try:
            store = Store.open(settings.data, floor_bytes=settings.disk_floor_bytes, new=options.new)
        except BaseException:
            listener.close()
            raise
    with logging_to_stderr(settings.log_format):
        for name in sorted(REMOVED_VARIABLES & os.environ.keys()):
            log.warning("%s is no setting any more and does nothing: a proxy bounds slow clients", name)
        if settings.keys == "none" and keys_were_made(settings.data):
            log.warning("SPLATLIFT_KEYS is none: nobody needs a key, though keys were made for %s", settings.data)
        try:
            app = assemble(settings, store)
            app.state.documents.get(keys=False)  # for whoever comes first, and for all who come at once
            keep_pauses_short()
            announce = partial(say_in_json, data=settings.data) if options.json else say
            server_of(app, settings, announce).run(sockets=[listener])
        finally:
            store.close()
            listener.close()
    return 0


def settings_of(options: argparse.Namespace) -> ServiceSettings:
    """Settings from the command line, else from the environment, else their defaults.

    Raises:
        Misconfigured: a value that a setting does not take.
    """
    pairs = [text.partition("=") for text in options.text_spaces or ()]
    for name, _, spec in pairs:
        if not (name and spec):
            raise Misconfigured("--text-space", expected="NAME=SPEC", got=repr(f"{name}={spec}"))
    values = {name: getattr(options, name) for name in ("host", "port", "data", "encoder")}
    return read_settings(**values, text_spaces={name: spec for name, _, spec in pairs} or None)


@contextmanager
def data_directory_errors() -> Iterator[None]:
    """Tell in one line of a disk that is full, may only be read or fails, and of a database that does.

    Raises:
        Misconfigured: in place of OSError and sqlite3.Error.
    """
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise Misconfigured("data", expected="a directory to read and write", got=str(error)) from error


def told_variables() -> str:
    """All settings, as ``--help`` tells them."""
    rows = (
        f"  {name}, default {default}\n{fill(meaning, 78, initial_indent=MARGIN, subsequent_indent=MARGIN)}"
        for name, default, meaning in variables()
    )
    return "\n".join(("environment variables; options win, and an empty variable is not set:", *rows))


def require_keys(settings: ServiceSettings) -> None:
    """See that nobody beyond this machine comes in without a key.

    Raises:
        Misconfigured: the address is not loopback, and there is no key.
    """
    if is_loopback(settings.host) or settings.keys == "required":
        return
    if settings.keys == "none":
        raise Misconfigured(
            "host", expected="a loopback address such as 127.0.0.1, as SPLATLIFT_KEYS is none", got=settings.host
        )
    if not any_key(settings.data / DATABASE):
        raise Misconfigured(
            "host", expected="a loopback address such as 127.0.0.1, as there are no keys", got=settings.host,
            hint=f"make one first: splatlift keys create --name NAME --scopes read,write --data {settings.data}",
        )  # fmt: skip


def require_files(settings: ServiceSettings) -> None:
    """Raise the number of files that we may open as far as we may, and see that every connection can have its own.

    Raises:
        Misconfigured: there would be too few of them.
    """
    required = FILES_A_CONNECTION * settings.max_connections + FILES_BESIDE
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= hard < required:
        raise Misconfigured(
            "max_connections", expected=f"at most {max(0, (hard - FILES_BESIDE) // FILES_A_CONNECTION)}, as a"
            f" process may open {hard} files here", got=f"{settings.max_connections}", hint="or raise ulimit -n",
        )  # fmt: skip
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    except (ValueError, OSError):  # a kernel that has a limit of its own below the one it tells
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, required) if soft >= 0 else soft, hard))


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        Misconfigured: the address is not of this machine, or it is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Only where TCP is named does asyncio send at once; else answers on kept connections wait 40 ms for the client.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        got = f"{host} port {port}: {error.strerror}"
        raise Misconfigured("host", expected="an address of this machine, with a free port", got=got) from None
    return listener


def server_of(app: FastAPI, settings: ServiceSettings, announce: Callable[[str], None] = say) -> AnnouncingServer:
    """The server of an application, which announces the address at which it listens."""
    proxies = settings.forwarded_allow
    config = uvicorn.Config(
        app, http="h11", ws="none", log_config=None, log_level="warning", access_log=False, server_header=False,
        limit_concurrency=settings.max_connections + 1,  # with the one that asks
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=math.ceil(settings.stop_seconds),
        proxy_headers=bool(proxies), forwarded_allow_ips=proxies,
    )  # fmt: skip
    return AnnouncingServer(config, app.state.stopping, settings.max_connections, announce)


def keep_pauses_short() -> None:
    """Let no thread, and no collection of cycles, hold up the event loop for long."""
    sys.setswitchinterval(SWITCH_SECONDS)
    gc.set_threshold(700, 10, 10)  # Python's own: other commands collect less often
    gc.collect()
    gc.freeze()  # modules and routes are most of what there ever is: looking through them took 20 to 40 ms
