"""``splatlift serve`` and ``python -m service``: run the service on this machine."""

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

FILES_A_CONNECTION = 2  # its socket, and a file that is sent over it
SWITCH_SECONDS = 0.0005  # of computation by a thread while the event loop waits; a tenth of Python's default
MARGIN = " " * 6  # before the description of a variable in --help
# Seconds that a connection is kept after an answer: more than in the pools of clients and proxies (httpx 5 s, aiohttp
# 15 s, nginx 60 s). With an equal number a client may send its next request while the server closes the connection.
KEEP_ALIVE_SECONDS = 75
IDLE_SECONDS = 1.0  # without a request in progress; then the connection may be closed for a new one
FILES_BESIDE = 128  # of the database, checks, jobs and the query worker

log = logging.getLogger(__name__)


class AnnouncingServer(uvicorn.Server):
    """Announce the address after the start, and stop in order: a stop by a signal is no failure.

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
        # Connection and its last completed request -> seconds of the monotonic clock
        self._idle_since: dict[tuple[Any, Any], float] = {}

    async def on_tick(self, counter: int) -> bool:
        """Close the longest idle connections if there is no room for a new one; called ten times a second."""
        now, connections = time.monotonic(), self.server_state.connections
        requests = ((each, getattr(each, "cycle", None)) for each in connections)
        self._idle_since = {
            last: self._idle_since.get(last, now)  # a new request since the last tick resets the time
            for last in requests
            if last[1] is None or last[1].response_complete
        }
        surplus = len(connections) - self._max_connections + 1  # including the next one
        for last in sorted(self._idle_since, key=self._idle_since.__getitem__)[: max(0, surplus)]:
            if now - self._idle_since[last] >= IDLE_SECONDS and not last[0].transport.is_closing():
                last[0].shutdown()
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at the first signal, at once at a second SIGINT. uvicorn would raise the signal after the stop."""
        self.force_exit = self.force_exit or (self.should_exit and sig == signal.SIGINT)
        self.should_exit = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Refuse work and requeue running jobs while the port still answers, then close the port."""
        await self._stopping.begin(lambda: self.force_exit)
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then announce the address."""
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            name = f"[{host}]" if ":" in host else host
            self._announce(f"http://{name}:{port}")


def print_address(address: str) -> None:
    """Print where the server listens, for people."""
    print(f"listening on {address}", flush=True)


def print_json(address: str, data: Path) -> None:
    """Print the address and the data directory as JSON, for programs."""
    print(json.dumps({"address": address, "data": str(data.absolute())}), flush=True)


def add_arguments(parser: Parser) -> None:
    """Add the options of the command; the end of its help lists all settings."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, list_variables()
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
            app.state.documents.get(keys=False)  # made before the first requests, which may come at once
            keep_pauses_short()
            announce = partial(print_json, data=settings.data) if options.json else print_address
            server_of(app, settings, announce).run(sockets=[listener])
        finally:
            store.close()
            listener.close()
    return 0


def settings_of(options: argparse.Namespace) -> ServiceSettings:
    """Return the settings: of the command line, else of the environment, else the defaults.

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
    """Convert errors of the disk and the database to one line: full, read-only or failing.

    Raises:
        Misconfigured: in place of OSError and sqlite3.Error.
    """
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise Misconfigured("data", expected="a directory to read and write", got=str(error)) from error


def list_variables() -> str:
    """Return the list of all settings for ``--help``."""
    rows = (
        f"  {name}, default {default}\n{fill(meaning, 78, initial_indent=MARGIN, subsequent_indent=MARGIN)}"
        for name, default, meaning in variables()
    )
    return "\n".join(("environment variables; options win, and an empty variable is not set:", *rows))


def require_keys(settings: ServiceSettings) -> None:
    """Require keys if the service is reachable from other machines.

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
    """Raise the limit of open files as far as allowed, and require enough for every connection.

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
    except (ValueError, OSError):  # some kernels have a lower limit than they report
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, required) if soft >= 0 else soft, hard))


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises:
        Misconfigured: the address is not of this machine, or it is taken.
    """
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


def server_of(
    app: FastAPI, settings: ServiceSettings, announce: Callable[[str], None] = print_address
) -> AnnouncingServer:
    """Return the server of an application, which announces its address."""
    proxies = settings.forwarded_allow
    config = uvicorn.Config(
        app, http="h11", ws="none", log_config=None, log_level="warning", access_log=False, server_header=False,
        limit_concurrency=settings.max_connections + 1,  # including the current one
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=math.ceil(settings.stop_seconds),
        proxy_headers=bool(proxies), forwarded_allow_ips=proxies,
    )  # fmt: skip
    return AnnouncingServer(config, app.state.stopping, settings.max_connections, announce)


def keep_pauses_short() -> None:
    """Keep threads and the collector of cycles from blocking the event loop for long."""
    sys.setswitchinterval(SWITCH_SECONDS)
    gc.set_threshold(700, 10, 10)  # Python's default: other commands collect less often
    gc.collect()
    gc.freeze()  # skip modules and routes in later collections: they took 20 to 40 ms
