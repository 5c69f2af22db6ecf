"""One lift on the service's page, on a local port, until Ctrl-C: ``python -m service.view LIFT``.

A temporary data directory holds links to the lift and to the files that it was made of: nothing is copied, and what
is deleted on the page is a link.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidLift, SplatliftError
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS
from service.__main__ import bind, server_of
from service.app import assemble
from service.encoders import require_encoder_files
from service.errand import ErrandLimits
from service.errors import Misconfigured
from service.models import AssetKind
from service.observe import logging_to_stderr
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.lifts import FinishedLift, order_of
from service.store.owners import SERVICE
from service.store.rebuild import header_of
from service.store.store import Store
from service.uploads.intake import check


def adopt(store: Store, settings: ServiceSettings, path: Path) -> str:
    """Give a store a lift and what it was made of, by links; the lift's id there.

    Packs that moved are left out: only examples of regions need them.

    Raises:
        InvalidLift: it is no lift, or its splats or cameras are not where it remembers them.
        InvalidInput: one of its files is malformed, or of a format that may hold code.
    """
    told, shape = metadata_of(path)
    order = order_of(told)
    packs = list(zip(told["features"], order.features, strict=True))
    kept = [(pack, asset) for pack, asset in packs if Path(pack["path"]).is_file()]
    _link(store, settings, AssetKind.SPLATS, told["splats"], path)
    _link(store, settings, AssetKind.CAMERAS, told["cameras"], path)
    for pack, _ in kept:
        _link(store, settings, AssetKind.FEATURES, pack, path)
    lift = secrets.token_hex(16)
    store.files.lift(lift).symlink_to(path.resolve())
    with path.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    made = FinishedLift(store.files.lift(lift), digest, shape[0], shape[1], told)
    store.lifts.adopt(SERVICE, lift, replace(order, features=tuple(asset for _, asset in kept)), made)
    return lift


def metadata_of(path: Path) -> tuple[dict[str, Any], list[int]]:
    """What a lift file tells of itself, and the shape of its features.

    Raises:
        InvalidLift: it is none.
    """
    _, metadata, shape = header_of(path)
    if "splatlift" not in metadata or len(shape) != 2:
        raise InvalidLift(str(path), expected="a lift file", got="a file without a lift's metadata")
    return json.loads(metadata["splatlift"]), shape


def _link(store: Store, settings: ServiceSettings, kind: AssetKind, file: dict[str, str], lift: Path) -> None:
    source = Path(file["path"])
    if not file["path"] or not source.exists():
        got = "nothing there" if file["path"] else "a lift of values in memory"
        raise InvalidLift(str(lift), expected=f"its {kind} at {file['path'] or 'a path'}", got=got)
    with store.files.scratch() as scratch:
        limits = ErrandLimits(settings.check_seconds, settings.check_memory_bytes, threading.Event())
        report = check(kind, source, scratch, limits)
    path = store.files.blob(file["sha256"], report.suffix)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(source.resolve() if source.is_file() else source)
    store.assets.add(
        SERVICE, CheckedUpload(path, kind, file["sha256"], report.suffix, report.counts, report.warnings)
    )


def settings_of(folder: Path, port: int, text_space: str) -> ServiceSettings:
    """Settings of a server for this machine alone, with the encoder of the lift's text space, if it is here.

    Spaces of encoders that ship, and those that the environment names, are answered as by any server.
    """
    own: dict[str, Any] = {"data": folder, "host": "127.0.0.1", "port": port}
    settings = ServiceSettings(**own)
    if text_space in ("", NO_WORDS, OWN_WORDS, *BUILT_IN.values(), *settings.text_spaces):
        return settings
    known = settings.model_copy(update={"text_spaces": {**settings.text_spaces, text_space: text_space}})
    try:
        require_encoder_files(known)
    except Misconfigured:
        return settings
    return known


def main(arguments: Sequence[str] | None = None) -> int:
    """Show the lift until the process is told to stop; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m service.view", description=__doc__)
    parser.add_argument("lift", type=Path)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--no-browser", action="store_true")
    lent = "end when stdin closes, as the end of whoever started this closes it, and take the folder away then"
    parser.add_argument("--lent", type=Path, metavar="FOLDER", help=lent)
    given = parser.parse_args(arguments)
    if given.lent is None:
        return serve(given.lift, given.port, browser=not given.no_browser)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # in order, until the server takes signals itself
    threading.Thread(target=stop_when_stdin_closes, daemon=True).start()
    try:
        return serve(given.lift, given.port, browser=not given.no_browser)
    finally:
        shutil.rmtree(given.lent, ignore_errors=True)


def serve(path: Path, port: int, *, browser: bool) -> int:
    """Show the lift at a port, over a data directory that goes with the server; the exit status."""
    with tempfile.TemporaryDirectory(prefix="splatlift-view-") as folder:
        try:
            settings = settings_of(Path(folder), port, metadata_of(path)[0].get("text_space", ""))
            listener = bind(settings.host, settings.port)
            store = Store.open(settings.data, floor_bytes=0)
            try:
                show = partial(announce, lift=adopt(store, settings, path), browser=browser)
                with logging_to_stderr(settings.log_format):
                    server_of(assemble(settings, store), settings, show).run(sockets=[listener])
            finally:
                store.close()
                listener.close()
        except SplatliftError as error:
            print(f"splatlift: {error}", file=sys.stderr)
            return 2
    return 0


def stop_when_stdin_closes() -> None:
    """Stop this process in order once nobody holds the other end of the pipe, however that one ended."""
    while os.read(0, 1 << 16):  # not by sys.stdin, whose lock a thread that waits would keep beyond the end
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def announce(address: str, *, lift: str, browser: bool) -> None:
    """Tell where the page is, and open it."""
    page = f"{address}/?lift={lift}"
    print(f"{page} (Ctrl-C ends it)", flush=True)
    if browser:
        threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
