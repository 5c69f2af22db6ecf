"""``splatlift view`` and ``result.show()``: show one lift on the service's page, on a local port, until Ctrl-C.

A temporary data directory holds links to the lift and to the files that it was made of: nothing is copied, and what
is deleted on the page is a link. What a lift of Python has in memory alone is written to another one beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import webbrowser
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli import Parser
from liftcore.errors import InvalidInput, InvalidLift, Unavailable
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS
from service.app import assemble
from service.commands.serve import bind, server_of
from service.errors import Misconfigured
from service.models import AssetKind
from service.observe import logging_to_stderr
from service.settings import ServiceSettings, read_settings, require_encoder_files
from service.store.assets import CheckedUpload
from service.store.files import sha256_of
from service.store.lifts import FinishedLift, order_of
from service.store.owners import SERVICE
from service.store.recovery import check_file, header_of
from service.store.store import Store

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore import Camera, LiftResult, Splats

LAST_PORT = 65_535
ENDING_SECONDS = 10.0  # for a server that was interrupted to end
FOLDER_PREFIX = "splatlift-show-"
FOLDER_VARIABLE = "SPLATLIFT_SHOW_FOLDER"  # from `show` to the process that removes the folder; not an option


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors), whose splats and cameras are where they were")
    parser.add_argument("--port", type=int, default=0, help="the port of this machine; 0 picks a free one")
    parser.add_argument("--no-browser", action="store_true", help="print the address, and open nothing")


def run(options: argparse.Namespace) -> int:
    """Show the lift until Ctrl-C; a folder of `show` is removed when the other end of stdin closes.

    Raises:
        InvalidInput: the environment names a folder that `show` did not make for this lift.
    """
    folder = os.environ.pop(FOLDER_VARIABLE, "")
    if not folder:
        _serve(options.lift, options.port, browser=not options.no_browser)
        return 0
    if not (options.lift.parent == Path(folder) and options.lift.parent.name.startswith(FOLDER_PREFIX)):
        expected = f"the folder {FOLDER_PREFIX}... of the lift"
        raise InvalidInput(FOLDER_VARIABLE, expected=expected, got=repr(folder)[:80], hint="unset it")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # exit in order until the server handles signals itself
    threading.Thread(target=stop_when_stdin_closes, daemon=True).start()
    try:
        _serve(options.lift, options.port, browser=not options.no_browser)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return 0


def show(
    lift: LiftResult, splats: Splats | None, cameras: Mapping[str, Camera] | None, *, port: int, browser: bool
) -> None:
    """Serve a lift until Ctrl-C: `LiftResult.show`."""
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= LAST_PORT:
        expected = f"a whole number in 0..{LAST_PORT}, 0 for a free one"
        raise InvalidInput("port", expected=expected, got=repr(port)[:80])
    with tempfile.TemporaryDirectory(prefix=FOLDER_PREFIX, ignore_cleanup_errors=True) as folder:
        path = lift.save_scene(Path(folder), splats, cameras)
        command = [sys.executable, "-m", "liftcore.cli", "view", str(path), "--port", str(port)]
        command += ["--no-browser"] * (not browser)
        environment = os.environ | {FOLDER_VARIABLE: folder}  # the server removes it: a kernel may be killed
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        ) as server:
            assert server.stdout is not None
            try:
                for line in server.stdout:
                    print(line, end="", flush=True)  # flushed for the cell of a notebook
            except KeyboardInterrupt:  # the server received it too
                server.terminate()
                with suppress(subprocess.TimeoutExpired):
                    server.wait(ENDING_SECONDS)
                server.kill()
                return
        if server.returncode:
            got = f"one that ended with status {server.returncode}; what it said stands above"
            raise Unavailable("the page", expected="a server that starts", got=got)


def adopt(store: Store, settings: ServiceSettings, path: Path) -> str:
    """Add a lift and the files that it was made of to a store, by links; return the lift's id.

    Packs that moved are left out: only examples of regions need them.

    Raises:
        InvalidLift: it is no lift, or its splats or cameras are not where it remembers them.
        InvalidInput: one of its files is malformed, or of a format that may hold code.
    """
    metadata, shape = metadata_of(path)
    order = order_of(metadata)
    packs = list(zip(metadata["features"], order.features, strict=True))
    present = [(pack, asset) for pack, asset in packs if Path(pack["path"]).is_file()]
    _link(store, settings, AssetKind.SPLATS, metadata["splats"], path)
    _link(store, settings, AssetKind.CAMERAS, metadata["cameras"], path)
    for pack, _ in present:
        _link(store, settings, AssetKind.FEATURES, pack, path)
    lift = secrets.token_hex(16)
    store.files.lift(lift).symlink_to(path.resolve())
    record = FinishedLift(store.files.lift(lift), sha256_of(path), shape[0], shape[1], metadata)
    store.lifts.adopt(SERVICE, lift, replace(order, features=tuple(asset for _, asset in present)), record)
    return lift


def metadata_of(path: Path) -> tuple[dict[str, Any], list[int]]:
    """Return the metadata of a lift file and the shape of its features.

    Raises:
        InvalidLift: it is none.
    """
    if path.is_dir():
        raise InvalidLift(str(path), expected="a lift file (.safetensors)", got="a folder")
    _, metadata, shape = header_of(path)
    if "splatlift" not in metadata or len(shape) != 2:
        raise InvalidLift(str(path), expected="a lift file", got="a file without a lift's metadata")
    return json.loads(metadata["splatlift"]), shape


def _link(store: Store, settings: ServiceSettings, kind: AssetKind, file: dict[str, str], lift: Path) -> None:
    source = Path(file["path"])
    if not file["path"] or not source.exists():
        got = "nothing there" if file["path"] else "a lift of values in memory"
        raise InvalidLift(str(lift), expected=f"its {kind} at {file['path'] or 'a path'}", got=got)
    report = check_file(store, settings, kind, source)
    path = store.files.blob(file["sha256"], report.suffix)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(source.resolve() if source.is_file() else source)
    store.assets.add(
        SERVICE, CheckedUpload(path, kind, file["sha256"], report.suffix, report.counts, report.warnings)
    )


def settings_of(folder: Path, port: int, text_space: str) -> ServiceSettings:
    """Return the settings of a server for this machine only, with the encoder of the lift's text space if known.

    Spaces of encoders that ship, and those that the environment names, are answered as by any server.
    """
    values: dict[str, Any] = {"data": folder, "host": "127.0.0.1", "port": port}
    settings = read_settings(**values)
    if text_space in ("", NO_WORDS, OWN_WORDS, *BUILT_IN.values(), *settings.text_spaces):
        return settings
    extended = settings.model_copy(update={"text_spaces": {**settings.text_spaces, text_space: text_space}})
    try:
        require_encoder_files(extended)
    except Misconfigured:
        return settings
    return extended


def _serve(path: Path, port: int, *, browser: bool) -> None:
    """Show the lift on a port, over a data directory that is removed with the server."""
    with tempfile.TemporaryDirectory(prefix="splatlift-view-") as folder:
        settings = settings_of(Path(folder), port, metadata_of(path)[0].get("text_space", ""))
        listener = bind(settings.host, settings.port)
        store = Store.open(settings.data, floor_bytes=0)
        try:
            announce_lift = partial(announce, lift=adopt(store, settings, path), browser=browser)
            with logging_to_stderr(settings.log_format):
                server_of(assemble(settings, store), settings, announce_lift).run(sockets=[listener])
        finally:
            store.close()
            listener.close()


def stop_when_stdin_closes() -> None:
    """Stop this process in order once the other end of the pipe is closed."""
    while os.read(0, 1 << 16):  # not sys.stdin: the thread would hold its lock at the exit
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def announce(address: str, *, lift: str, browser: bool) -> None:
    """Print the address of the page, and open it."""
    page = f"{address}/?lift={lift}"
    print(f"{page} (Ctrl-C ends it)", flush=True)
    if browser:
        threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()
