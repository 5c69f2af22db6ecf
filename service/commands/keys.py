"""``splatlift keys``: create, list, rotate and revoke keys, with or without a running server."""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from liftcore.cli import Parser, whole_number
from liftcore.errors import NotFound
from service.commands.serve import data_directory_errors
from service.errors import InvalidRequest
from service.models import LAST_MOMENT, within_calendar
from service.settings import read_settings
from service.store.database import DATABASE, Database
from service.store.keys import KeyRecord, KeyStore, Quota
from service.store.owners import Scope, parse_scopes

MAX_NAME = 100
QUOTAS = {
    "max_bytes": "most bytes stored, of its assets and lifts",
    "max_queued": "most jobs in line",
    "max_uploads": "most uploads at once",
}
UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}


def add_arguments(parser: Parser, shared: Parser) -> None:
    """Add the options of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    create = actions.add_parser("create", parents=[shared], help="make a key and show it, once")
    create.add_argument("--name", required=True, metavar="NAME", help="its owner or purpose")
    create.add_argument("--scopes", metavar="SCOPES", help="its rights: read,write,metrics,admin")
    create.add_argument("--lifts", metavar="IDS", help="in place of scopes: lifts that it may read and query")
    create.add_argument("--expires", metavar="WHEN", help="after 30d, 12h or 90m, or at a date (UTC); else never")
    for name, limit in QUOTAS.items():
        option = f"--{name.replace('_', '-')}"
        create.add_argument(option, type=whole_number, metavar="N", help=f"{limit}; else as the server is set")
    listing = actions.add_parser("list", parents=[shared], help="all keys, without their secrets")
    rotate = actions.add_parser("rotate", parents=[shared], help="give a key another secret and show it, once")
    rotate.add_argument("key", metavar="NAME", help="its name, or its id as keys list shows it")
    rotate.add_argument(
        "--grace", metavar="TIME", help="how long the secret before counts, such as 24h; else not at all"
    )
    rotate.add_argument(
        "--keep-shares",
        action="store_true",
        help="keep the keys that it shared lifts with; else they end with the secret before",
    )
    revoke = actions.add_parser("revoke", parents=[shared], help="end a key and keys that it made; its results stay")
    revoke.add_argument("key", metavar="ID", help="as keys list shows it")
    for action in (create, listing, rotate, revoke):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    action = {"create": _create, "list": _list, "rotate": _rotate, "revoke": _revoke}[options.action]
    with data_directory_errors(), open_keys(read_settings(data=options.data).data, make=action is _create) as keys:
        action(keys, options)
    return 0


@contextmanager
def open_keys(data: Path, *, make: bool) -> Iterator[KeyStore]:
    """Open the keys of a data directory, also while a server holds it.

    Raises:
        NotFound: there is no database, and none is to be made.
        StaleDatabase: it is gone, or older than the files.
        Misconfigured: a release with another schema wrote it.
    """
    path = data / DATABASE
    if make:
        data.mkdir(parents=True, exist_ok=True)
    elif not path.exists():
        raise NotFound("data", expected="the data directory of a service", got=str(data), hint="name it with --data")
    database = Database(path)
    try:
        yield KeyStore(database, data)
    finally:
        database.close()


def _create(keys: KeyStore, options: argparse.Namespace) -> None:
    name = options.name.strip()
    if not name or len(name) > MAX_NAME or not name.isprintable():
        raise InvalidRequest("name", expected=f"1 to {MAX_NAME} printable characters", got=repr(options.name)[:120])
    quota = Quota(options.max_bytes, options.max_queued, options.max_uploads)
    expires = None if options.expires is None else _moment(options.expires)
    lifts = [lift.strip() for lift in (options.lifts or "").split(",") if lift.strip()]
    scopes = parse_scopes((options.scopes or (Scope.SHARED if lifts else "")).split(","))
    key, secret = keys.create(name, scopes, quota, expires=expires, lifts=lifts)
    _show(key, secret, options)


def _rotate(keys: KeyStore, options: argparse.Namespace) -> None:
    grace = 0.0 if options.grace is None else _seconds("grace", options.grace)
    key, secret, shares = keys.rotate(options.key, grace=grace, keep_shares=options.keep_shares)
    _show(key, secret, options, ended_shares=[share.id for share in shares])
    if shares and not options.json:
        print(f"The secret before ends{_with(shares)}. With --keep-shares they would stay.", file=sys.stderr)


def _show(key: KeyRecord, secret: str, options: argparse.Namespace, **fields: Any) -> None:
    if options.json:
        print(json.dumps({**_document(key), **fields, "key": secret}))
        return
    print(secret)
    until = "" if key.expires is None else f", until {_format_time(key.expires)}"
    print(
        f"key {key.id} of {key.name}: {', '.join(sorted(key.scopes))}{until}. It is shown this once.", file=sys.stderr
    )


def _seconds(argument: str, text: str, alternative: str = "") -> float:
    """Parse a duration such as 30d; return seconds."""
    match = re.fullmatch(r"(\d{1,6})([smhd])", text.strip(), re.ASCII)
    if match is None:
        expected = f"a number of at most 6 digits with d, h, m or s, such as 30d or 12h{alternative}"
        raise InvalidRequest(argument, expected=expected, got=repr(text)[:80])
    return int(match[1]) * UNITS[match[2]]


def _moment(text: str) -> float:
    """Parse a duration from now, or a date; return seconds since 1970."""
    now = time.time()
    try:
        date = datetime.fromisoformat(text.strip())
        moment = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    except ValueError:
        moment = now + _seconds("expires", text, ", or a date (UTC) such as 2030-12-31")
    if not now < moment <= LAST_MOMENT:
        raise InvalidRequest("expires", expected="a moment after now and at most 9999-12-31 (UTC)", got=text)
    return moment


def _list(keys: KeyStore, options: argparse.Namespace) -> None:
    records = keys.all()
    if options.json:
        print(json.dumps({"keys": [_document(key) for key in records]}))
        return
    for key in records:
        scopes = ",".join(sorted(key.scopes)) + ("" if key.maker is None else f" by {key.maker}")
        print("  ".join([key.id, _format_time(key.created), _state(key), scopes, _limits(key), key.name]))
    if not records:
        closed = "no keys, but there were some: nobody is let in until one is made"
        none = "no keys: the service is open to this machine, and to no other"
        print(closed if keys.required() else none, file=sys.stderr)


def _revoke(keys: KeyStore, options: argparse.Namespace) -> None:
    key, shares = keys.revoke(options.key)
    if options.json:
        print(json.dumps({**_document(key), "ended_shares": [share.id for share in shares]}))
    else:
        print(f"key {key.id} of {key.name} is revoked{_with(shares)}")


def _with(shares: Sequence[KeyRecord]) -> str:
    """Revoke the keys shared by a key; print nothing if there are none."""
    if not shares:
        return ""
    return f", and with it {len(shares)} that it made: " + ", ".join(
        f"{share.id} of {share.name}" for share in shares
    )


def _document(key: KeyRecord) -> dict[str, Any]:
    fields = asdict(key)
    quota = fields.pop("quota")
    return {**fields, **quota, "scopes": sorted(key.scopes)}


def _state(key: KeyRecord) -> str:
    if key.revoked is not None:
        return f"revoked {_format_time(key.revoked)}"
    if key.expires is None:
        return "valid"
    return f"{'expired' if key.expires <= time.time() else 'valid until'} {_format_time(key.expires)}"


def _limits(key: KeyRecord) -> str:
    limits = {"bytes": key.quota.max_bytes, "queued": key.quota.max_queued, "uploads": key.quota.max_uploads}
    return ",".join(f"{name}={value}" for name, value in limits.items() if value is not None) or "-"


def _format_time(seconds: float) -> str:
    moment = datetime.fromtimestamp(within_calendar(seconds), UTC)
    return moment.replace(tzinfo=None).isoformat(" ", "minutes") + "Z"
