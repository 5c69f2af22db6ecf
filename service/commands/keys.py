"""``splatlift keys``: create, list and revoke keys, with or without a running server."""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from liftcore.cli import Parser
from liftcore.errors import NotFound
from service.auth import SCOPES
from service.commands.serve import data_directory_errors
from service.errors import InvalidRequest
from service.models import NAME_CHARACTERS, Key
from service.settings import read_settings
from service.store import create_key, list_keys, open_keys, revoke_key

UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    create = actions.add_parser("create", parents=[shared], help="make a key and show it, once")
    create.add_argument("--name", required=True, metavar="NAME", help="its owner or purpose")
    create.add_argument("--scopes", metavar="SCOPES", help="its rights: read,write; or admin, for all owners' data")
    create.add_argument("--lifts", metavar="IDS", help="in place of scopes: lifts that it may read and query")
    create.add_argument("--expires", metavar="DURATION", help="such as 30d, 12h or 90m; else never")
    listing = actions.add_parser("list", parents=[shared], help="all keys, without their secrets")
    revoke = actions.add_parser("revoke", parents=[shared], help="end a key and its shares; its results stay")
    revoke.add_argument("key", metavar="ID", help="as keys list shows it")
    for action in (create, listing, revoke):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    data, creates = read_settings(data=options.data).data, options.action == "create"
    with data_directory_errors(), open_keys(data, make=creates) as connection:
        if options.action == "list":
            keys = list_keys(connection)
            _print(options, {"keys": [key.model_dump() for key in keys]}, "\n".join(map(_line, keys)))
            if not keys:
                print("no keys: the service is open to this machine, and to no other", file=sys.stderr)
        elif options.action == "revoke":
            key = revoke_key(connection, options.key)
            _print(options, key.model_dump(), f"key {key.id} of {key.name} is revoked, and its shares")
        else:
            lifts = [lift.strip() for lift in (options.lifts or "").split(",") if lift.strip()]
            known_lifts = {lift for (lift,) in connection.execute("SELECT id FROM lifts")}
            if unknown := set(lifts) - known_lifts:
                hint = "GET /lifts lists them"
                raise NotFound("--lifts", expected="ids of lifts", got=sorted(unknown)[0][:80], hint=hint)
            expires = None if options.expires is None else _end_of(options.expires)
            scopes = "shared" if lifts else _scopes(options.scopes or "")
            key, secret = create_key(connection, _name(options.name), scopes, expires, lifts)
            _print(options, {**key.model_dump(), "key": secret}, secret)
            print(f"{_line(key)}. The secret is shown this once.", file=sys.stderr)
    return 0


def _print(options: argparse.Namespace, document: dict[str, object], text: str) -> None:
    if options.json or text:
        print(json.dumps(document) if options.json else text)


def _name(text: str) -> str:
    name = text.strip()
    if not name or len(name) > NAME_CHARACTERS or not name.isprintable():
        expected = f"1 to {NAME_CHARACTERS} printable characters"
        raise InvalidRequest("--name", expected=expected, got=repr(text)[:120])
    return name


def _scopes(text: str) -> str:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or set(names) - set(SCOPES):
        raise InvalidRequest("--scopes", expected=f"one or more of {', '.join(SCOPES)}", got=text[:80] or "none")
    return " ".join(sorted(set(names)))


def _end_of(duration: str) -> float:
    """Return the end of a duration from now, such as 30d: seconds since 1970."""
    match = re.fullmatch(r"([1-9]\d{0,5})([smhd])", duration.strip(), re.ASCII)
    if match is None:
        expected = "a duration such as 30d, 12h or 90m"
        raise InvalidRequest("--expires", expected=expected, got=repr(duration)[:80])
    return time.time() + int(match[1]) * UNITS[match[2]]


def _line(key: Key) -> str:
    state = "valid"
    if key.revoked is not None:
        state = f"revoked {_format_time(key.revoked)}"
    elif key.expires is not None:
        state = f"{'expired' if key.expires <= time.time() else 'valid until'} {_format_time(key.expires)}"
    scopes = key.scopes.replace(" ", ",") + (f" by {key.maker}" if key.maker else "")
    return "  ".join([key.id, _format_time(key.created), state, scopes, key.name])


def _format_time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None).isoformat(" ", "minutes") + "Z"
