"""``splatlift store``: rebuild, back up, restore and verify a data directory."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from liftcore.cli import Parser
from liftcore.errors import NotFound
from service.commands.serve import data_directory_errors
from service.settings import ServiceSettings, read_settings
from service.store.database import DATABASE
from service.store.recovery import back_up, rebuild, restore, verify
from service.store.store import Store

LOST_FILES_HINT = (
    "what the database alone held is not made again: keys, owners (what was added is of admins alone), trade-offs,"
    " selections, names of objects, jobs without a lift, histories of jobs"
)


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    rebuild = actions.add_parser("rebuild", parents=[shared], help="rebuild rows of files that the database lacks")
    backup = actions.add_parser("backup", parents=[shared], help="copy a data directory, beside a server that runs")
    backup.add_argument("directory", type=Path, metavar="DIR", help="the backup, which is not there yet")
    restore = actions.add_parser("restore", parents=[shared], help="make a data directory of a backup")
    restore.add_argument("directory", type=Path, metavar="DIR", help="the backup")
    verify = actions.add_parser("verify", parents=[shared], help="compare every file with its digest")
    for action in (rebuild, backup, restore, verify):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Run the command; return 1 if `verify` finds damage."""
    with data_directory_errors():
        settings = read_settings(data=options.data)
        if options.action == "restore":
            document = {"files": restore(options.directory, settings.data)}
            return _reply(options, document, f"restored to {settings.data}")
        _require_directory(settings.data)
        if options.action == "backup":
            document = {"files": back_up(settings.data, options.directory)}
            return _reply(options, document, f"{DATABASE} and {document['files']} files are in {options.directory}")
        if options.action == "verify":
            damage = verify(settings.data)
            _reply(options, {"damage": damage}, "\n".join(damage) or "every file is as it was stored")
            return 1 if damage else 0
        return _rebuild(options, settings)


def _require_directory(data: Path) -> None:
    if not data.is_dir():
        raise NotFound("data", expected="the data directory of a service", got=str(data), hint="name it with --data")


def _rebuild(options: argparse.Namespace, settings: ServiceSettings) -> int:
    store = Store.open(settings.data, rebuilding=True)
    try:
        document = rebuild(store, settings)
    finally:
        store.close()
    kind_counts = [f"{count} of kind {kind}" for kind, count in sorted(document["assets"].items())]
    kinds = f" ({', '.join(kind_counts)})" if kind_counts else ""
    lines = [f"added to {DATABASE}: {sum(document['assets'].values())} assets{kinds}, {document['lifts']} lifts"]
    for file in document["left"]:
        lines.append(f"left out, and moved to quarantine, now or by the server: {file['file']}: {file['why']}")
    return _reply(options, {**document, "lost": LOST_FILES_HINT}, "\n".join([*lines, LOST_FILES_HINT]))


def _reply(options: argparse.Namespace, document: dict[str, Any], text: str) -> int:
    print(json.dumps(document) if options.json else text)
    return 0
