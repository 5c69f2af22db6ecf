"""``python -m service.store``: rebuild, back up, restore and verify a data directory."""

from __future__ import annotations

import argparse
import json
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from liftcore.cli import build_parser
from liftcore.errors import NotFound, SplatliftError
from service.__main__ import parse
from service.settings import ServiceSettings
from service.store.backup import back_up, restore, verify
from service.store.database import DATABASE
from service.store.rebuild import rebuild
from service.store.store import Store

LOST = (
    "what the database alone held is not made again: keys, owners (what was added is of admins alone), trade-offs,"
    " jobs without a lift, histories of jobs"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line says; the exit status: 1 where `verify` finds damage, 2 after an error."""
    given = build_parser().parse_args(["store", *(sys.argv[1:] if arguments is None else arguments)])
    try:
        settings = parse([] if given.data is None else ["--data", str(given.data)])
        if given.action == "restore":
            return _told(given, {"files": restore(given.directory, settings.data)}, f"restored to {settings.data}")
        _require_directory(settings.data)
        if given.action == "backup":
            found = {"files": back_up(settings.data, given.directory)}
            return _told(given, found, f"{DATABASE} and {found['files']} files are in {given.directory}")
        if given.action == "verify":
            damage = verify(settings.data)
            _told(given, {"damage": damage}, "\n".join(damage) or "every file is as it was stored")
            return 1 if damage else 0
        return _rebuild(given, settings)
    except SplatliftError as error:
        print(f"splatlift: {error}", file=sys.stderr)
    except (OSError, sqlite3.Error) as error:
        print(f"splatlift: data: expected a directory to read and write, got {error}", file=sys.stderr)
    return 2


def _require_directory(data: Path) -> None:
    if not data.is_dir():
        raise NotFound("data", expected="the data directory of a service", got=str(data), hint="name it with --data")


def _rebuild(given: argparse.Namespace, settings: ServiceSettings) -> int:
    store = Store.open(settings.data, rebuilding=True)
    try:
        found = rebuild(store, settings)
    finally:
        store.close()
    added = [f"{count} of kind {kind}" for kind, count in sorted(found["assets"].items())]
    kinds = f" ({', '.join(added)})" if added else ""
    lines = [f"added to {DATABASE}: {sum(found['assets'].values())} assets{kinds}, {found['lifts']} lifts"]
    for left in found["left"]:
        lines.append(f"left out, and to be moved to quarantine by the server: {left['file']}: {left['why']}")
    return _told(given, {**found, "lost": LOST}, "\n".join([*lines, LOST]))


def _told(given: argparse.Namespace, found: dict[str, Any], text: str) -> int:
    print(json.dumps(found) if given.json else text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
